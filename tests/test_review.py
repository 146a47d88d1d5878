"""Decisions about labels: they survive new maps of the same place, and nothing is decided silently."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.arrays import Floats
from valuemap.dataset import Frame
from valuemap.errors import InputError
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import REVIEW, Map, read_map, write_map
from valuemap.review import Matches, apply_review, decide, match_decisions, read_review, state_of, write_review
from valuemap.tables import Votes


def with_votes(result: Map, votes: int) -> Map:
    return replace(result, labels=result.labels.replace(votes=np.full(len(result.labels), votes)))


def certain(result: Map) -> Map:
    """Return the map with standard deviations of 2 cm: other passes have larger errors than those."""
    covariance = np.tile(0.0004 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), (len(result.labels), 1))
    return replace(result, labels=result.labels.replace(covariance_m2=covariance))


def rows(matches: Matches) -> list[int]:
    return [int(row) for row in matches.row_of_decision]


def map_with(places: list[float], voters: list[list[int]]) -> Map:
    """Return labels at these places along x, with these detections of the small dataset as voters."""
    detections = small_dataset().detections
    image_of = dict(zip(detections.detection_id.tolist(), detections.image_id.tolist(), strict=True))
    result = map_of([[x, 20, 5] for x in places], ["light"] * len(places))
    flat = [each for some in voters for each in some]
    votes = Votes(
        label_id=np.repeat(np.arange(len(places)), [len(some) for some in voters]),
        detection_id=np.array(flat),
        image_id=np.array([image_of[each] for each in flat]),
        residual_px=np.ones(len(flat)),
        residual_sigmas=np.ones(len(flat)),
    )
    return replace(result, votes=votes)


def kept(result: Map) -> list[int]:
    return [int(each) for each in result.labels.label_id]


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    result = map_of([[0, 0, 5], [0.6, 0, 5]], ["light", "light"])
    first = decide(result, 0, "rejected", note='a "reflection" <b>\n')
    second = decide(result, 1, "accepted", new_class="sign", new_position_in_world_m=(0.7, 0.1, 5.0))
    write_review(tmp_path / "review.json", [second, first], result.frame)
    assert read_review(tmp_path / "review.json", result.frame) == [first, second]
    assert read_review(tmp_path / "none.json", result.frame) == []


def test_rejected_is_dropped_and_corrections_are_applied() -> None:
    result = map_of([[0, 0, 5], [20, 0, 5], [40, 0, 5]], ["light"] * 3)
    decisions = [
        decide(result, 0, "rejected"),
        decide(result, 1, "accepted", new_class="sign", new_position_in_world_m=(21.0, 0.0, 5.0)),
    ]
    reviewed, outcome = apply_review(result, decisions)
    assert kept(reviewed) == [1, 2]
    assert reviewed.labels.class_name.texts() == ["sign", "light"]
    assert reviewed.labels.position_in_world_m[0].tolist() == [21.0, 0.0, 5.0]
    assert (outcome.accepted, outcome.rejected, outcome.check_again, outcome.without_label) == (1, 1, (), 0)


def test_votes_of_rejected_labels_go_with_them() -> None:
    result = map_of([[0, 0, 5], [20, 0, 5]], residual_px=[1.0, 2.0])
    assert len(apply_review(result, [decide(result, 1, "rejected")])[0].votes) == 2
    assert len(apply_review(result, [decide(result, 0, "rejected")])[0].votes) == 0


def test_the_right_one_of_two_heads_stays_rejected_when_both_move() -> None:
    """All passes' offset puts the other head where the rejected one was: the remembered neighbour takes its own."""
    before = map_of([[0, 0, 5], [0.6, 0, 5]])
    decisions = [decide(before, 0, "rejected")]
    after = map_of([[0.45, 0, 5], [1.05, 0, 5]])
    assert rows(match_decisions(decisions, after)) == [0]
    forgetful = [replace(decisions[0], neighbors=())]
    assert rows(match_decisions(forgetful, map_of([[0.6, 0, 5]]))) == [0]
    assert rows(match_decisions(decisions, map_of([[0.6, 0, 5]]))) == [-1]


def test_another_class_or_a_place_far_away_is_another_label() -> None:
    decisions = [decide(map_of([[0, 0, 5]], ["light"]), 0, "rejected")]
    assert rows(match_decisions(decisions, map_of([[0.2, 0, 5]], ["sign"]))) == [-1]
    assert rows(match_decisions(decisions, map_of([[4, 0, 5]], ["light"]))) == [-1]
    assert rows(match_decisions(decisions, map_of([[0.2, 0, 5]], ["light"]))) == [0]
    assert rows(match_decisions(decisions, map_of([]))) == [-1]


def test_an_uncertain_label_is_known_again_along_its_uncertainty_only() -> None:
    before = map_of([[0, 0, 5]])
    spread = before.labels.replace(covariance_m2=np.array([[9.0, 0, 0, 0.01, 0, 0.01]]))
    decisions = [decide(replace(before, labels=spread), 0, "rejected")]
    assert rows(match_decisions(decisions, map_of([[8, 0, 5]]))) == [0]
    assert rows(match_decisions(decisions, map_of([[0, 4, 5]]))) == [-1]


def test_the_boxes_that_voted_know_a_label_again_that_moved_and_changed_class() -> None:
    dataset = small_dataset()

    def map_at(x: float, class_name: str, detections: list[int]) -> Map:
        result = map_of([[x, 20, 5]], [class_name])
        row = np.searchsorted(dataset.detections.detection_id, detections)
        votes = Votes(
            label_id=np.zeros(len(detections), np.int64),
            detection_id=np.array(detections),
            image_id=dataset.detections.image_id[row],
            residual_px=np.ones(len(detections)),
            residual_sigmas=np.ones(len(detections)),
        )
        return replace(result, votes=votes)

    decisions = [decide(map_at(0, "light", [100, 101]), 0, "rejected", dataset=dataset)]
    assert [voter[0] for voter in decisions[0].voters] == ["a/1.jpg", "a/2.jpg"]
    moved = map_at(30, "sign", [101, 102])
    assert rows(match_decisions(decisions, moved, dataset)) == [0]
    assert rows(match_decisions(decisions, moved)) == [-1]
    # Other ids of the same boxes change nothing: names of pictures and places in them count.
    renumbered = replace(
        dataset,
        images=dataset.images.replace(image_id=dataset.images.image_id + 5),
        detections=dataset.detections.replace(
            detection_id=dataset.detections.detection_id + 3, image_id=dataset.detections.image_id + 5
        ),
    )
    votes = moved.votes.replace(detection_id=moved.votes.detection_id + 3, image_id=moved.votes.image_id + 5)
    assert rows(match_decisions(decisions, replace(moved, votes=votes), renumbered)) == [0]


def test_of_two_heads_the_one_with_the_same_voters_is_known_again_and_missing_images_say_nothing() -> None:
    """One label between two heads was rejected; the next map, of half the images, has both heads."""
    dataset = small_dataset()
    decision = decide(map_with([0.1], [[100, 101, 102]]), 0, "rejected", dataset=dataset)
    after = map_with([0.0, 0.6], [[103], [100, 101]])
    assert rows(match_decisions([decision], after, dataset)) == [1]
    assert rows(match_decisions([replace(decision, voters=())], after, dataset)) == [0]
    # Most of the voters are in images that are not there: the others decide, wherever the label is.
    gone = tuple((f"elsewhere/{i}.jpg", 1.0, 1.0) for i in range(20))
    moved = map_with([30.0], [[100, 101, 102]])
    assert rows(match_decisions([replace(decision, voters=decision.voters + gone)], moved, dataset)) == [0]
    # A voter or two of many say nothing.
    few = replace(decision, voters=decision.voters[:2] + gone)
    assert rows(match_decisions([few], map_with([30.0], [[100, 101]]), dataset)) == [-1]


def test_a_new_map_in_the_same_folder_keeps_the_decisions(tmp_path: Path) -> None:
    result = map_of([[0, 0, 5]])
    write_map(result, tmp_path / "map")
    write_review(tmp_path / "map" / REVIEW, [decide(result, 0, "rejected")], result.frame)
    write_map(map_of([[0.1, 0, 5], [9, 0, 5]]), tmp_path / "map")
    again = read_map(tmp_path / "map")
    assert kept(apply_review(again, read_review(tmp_path / "map" / REVIEW, again.frame))[0]) == [1]


def test_twice_the_votes_ask_again_and_stay_out_until_answered() -> None:
    result = map_of([[0, 0, 5], [20, 0, 5]])
    decisions = [decide(result, 0, "rejected")]
    grown, doubled = with_votes(result, 9), with_votes(result, 10)
    assert state_of(decisions[0], grown.labels, 0) == "rejected"
    assert state_of(decisions[0], doubled.labels, 0) == "check again"
    reviewed, outcome = apply_review(doubled, decisions)
    assert kept(reviewed) == [1]
    assert outcome.check_again == (0,)
    assert apply_review(doubled, [decide(doubled, 0, "rejected")])[1].check_again == ()


def test_a_second_label_where_one_was_rejected_is_asked_about() -> None:
    """One head was seen and rejected; with other passes there are two, and the rejection takes either."""
    alone = certain(map_of([[0, 0, 5], [30, 0, 5]], ["light"] * 2))
    rejected = decide(alone, 0, "rejected")
    both = certain(map_of([[0.3, 0, 5], [-0.4, 0, 5], [30, 0, 5], [0.3, 0.2, 5]], ["light"] * 3 + ["sign"]))
    matches = match_decisions([rejected], both)
    assert rows(matches) == [0]
    assert matches.unsure == {1: 0}
    reviewed, outcome = apply_review(both, [rejected])
    assert (outcome.rejected, outcome.check_again, kept(reviewed)) == (1, (1,), [2, 3])
    # What stood there when it was rejected is known, and so is what was decided on; nobody asks about either.
    before = certain(map_of([[0.3, 0, 5], [-0.4, 0, 5]], ["light"] * 2))
    assert match_decisions([decide(before, 0, "rejected")], both).unsure == {}
    told = [rejected, decide(both, 1, "accepted")]
    assert match_decisions(told, both).unsure == {}
    assert match_decisions([decide(alone, 0, "accepted")], both).unsure == {}


def test_a_label_with_a_part_of_the_rejected_boxes_is_asked_about() -> None:
    dataset = small_dataset()
    before = map_with([0.0], [[100, 101, 102, 103]])
    rejected = decide(before, 0, "rejected", dataset=dataset)
    assert len(rejected.voters) == 4
    split = map_with([0.0, 40.0], [[100, 101, 102], [103]])  # Far away: its boxes are what it is known by.
    assert match_decisions([rejected], split, dataset).unsure == {1: 0}
    assert match_decisions([rejected], split).unsure == {}
    assert match_decisions([rejected], before, dataset).unsure == {}
    assert match_decisions([replace(rejected, verdict="accepted")], split, dataset).unsure == {}


def test_where_boxes_and_places_disagree_about_two_heads_the_other_one_is_asked_about() -> None:
    """One of two heads was rejected; in the next map each stands where the other one stood, with its own boxes."""
    dataset = small_dataset()
    before = map_with([0.0, 0.7], [[100, 101], [102, 103]])
    rejected = decide(before, 1, "rejected", dataset=dataset)
    exchanged = match_decisions([rejected], map_with([0.0, 0.7], [[102, 103], [100, 101]]), dataset)
    assert rows(exchanged) == [0]
    assert exchanged.unsure == {1: 0}
    same = match_decisions([rejected], before, dataset)
    assert (rows(same), same.unsure) == ([1], {})
    # Nobody is asked about what was decided on as well.
    told = [rejected, decide(before, 0, "accepted", dataset=dataset)]
    assert match_decisions(told, map_with([0.0, 0.7], [[102, 103], [100, 101]]), dataset).unsure == {}


def test_500_rejected_labels_stay_rejected_in_ten_maps() -> None:
    """New pose errors, other ids and order, missing and additional labels, heads 0.6 m apart."""
    random = np.random.default_rng(4)
    poles = np.column_stack([25.0 * (np.arange(600) % 30), 25.0 * (np.arange(600) // 30), random.uniform(3, 6, 600)])
    twins = poles + [0.6, 0.0, 0.0]
    true = np.concatenate([poles, twins])
    before = certain(map_of(true))
    rejected = random.choice(600, 500, replace=False)
    decisions = [decide(before, int(row), "rejected") for row in rejected]
    for _ in range(10):
        shown = np.flatnonzero(random.random(len(true)) < 0.95)
        random.shuffle(shown)
        offset = random.normal(0.0, 0.05, (600, 3))[shown % 600]  # Heads on one pole share the errors of the passes.
        new = random.uniform([10.0, 10.0, 3.0], [15.0, 15.0, 6.0], (50, 3)) + 25.0 * random.integers(0, 20, (50, 1))
        here = np.concatenate([true[shown] + offset + random.normal(0.0, 0.05, (len(shown), 3)), new])
        reviewed, outcome = apply_review(certain(map_of(here)), decisions)
        expected = [row for row in range(len(here)) if row >= len(shown) or shown[row] not in set(rejected.tolist())]
        assert kept(reviewed) == expected
        assert outcome.rejected + outcome.without_label == 500


def at_anchor(lon_lat_height: Floats, anchor: tuple[float, float, float]) -> Map:
    frame = Frame(anchor=anchor)
    return map_of(enu_from_lon_lat_height(lon_lat_height, anchor), frame=frame, lon_lat_height=lon_lat_height)


def test_decisions_follow_a_map_to_another_anchor(tmp_path: Path) -> None:
    place = lon_lat_height_from_enu(np.array([[10.0, 20.0, 5.0], [60.0, 20.0, 5.0]]), ANCHOR)
    before, after = at_anchor(place, ANCHOR), at_anchor(place, (51.51, -0.12, 0.0))
    corrected = (11.0, 20.0, 5.0)
    write_review(
        tmp_path / "r.json",
        [decide(before, 0, "accepted", new_position_in_world_m=corrected), decide(before, 1, "rejected")],
        before.frame,
    )
    decisions = read_review(tmp_path / "r.json", after.frame)
    reviewed, _ = apply_review(after, decisions)
    assert kept(reviewed) == [0]
    assert reviewed.labels.lon_lat_height is not None
    assert np.allclose(
        reviewed.labels.lon_lat_height, lon_lat_height_from_enu(np.array([corrected]), ANCHOR), atol=1e-8
    )
    with pytest.raises(InputError, match="frame of its own"):
        read_review(tmp_path / "r.json", Frame())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda content: content.update(format_version=9), "format_version: expected 1, found 9"),
        (lambda content: content.update(decisions={}), "expected a list"),
        (lambda content: content["decisions"][0].pop("class"), "decision 1: cannot be used"),
        (lambda content: content["decisions"][0].update(verdict="maybe"), "decision 1: expected a verdict"),
        (lambda content: content["decisions"][0].update(position_m=[1, 2]), "decision 1: cannot be used"),
        (lambda content: content["decisions"][0].update(label_id=float("inf")), "decision 1: cannot be used"),
        (lambda content: content["decisions"][0].update(position_m=[1, 2, float("nan")]), "decision 1: expected"),
        (lambda content: content["decisions"][0].update(new_position_m=[1, 2, float("nan")]), "decision 1: expected"),
        (
            lambda content: content["decisions"].append({**content["decisions"][0], "verdict": "accepted"}),
            r"decisions 1 \(rejected\) and 2 \(accepted\) are both about label 0 and differ",
        ),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, change: object, told: str) -> None:
    path = tmp_path / "review.json"
    result = map_of([[0, 0, 5]])
    write_review(path, [decide(result, 0, "rejected")], result.frame)
    content = json.loads(path.read_text())
    change(content)  # type: ignore[operator]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=told):
        read_review(path, result.frame)
    path.write_text("{")
    with pytest.raises(InputError, match="cannot be read as JSON"):
        read_review(path, result.frame)


def test_a_file_of_nothing_but_brackets_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "review.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="cannot be read as JSON"):
        read_review(tmp_path / "review.json", Frame())


def test_files_of_two_people_with_the_same_decision_and_a_mark_of_an_editor_are_read(tmp_path: Path) -> None:
    path = tmp_path / "review.json"
    result = map_of([[0, 0, 5]])
    decision = decide(result, 0, "rejected")
    write_review(path, [decision, decision], result.frame)
    path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert read_review(path, result.frame) == [decision]


def test_the_order_of_decisions_means_nothing() -> None:
    result = map_of([[0, 0, 5], [0.6, 0, 5], [9, 0, 5]])
    decisions = [decide(result, 0, "rejected"), decide(result, 1, "accepted"), decide(result, 2, "rejected")]
    later = map_of([[0.2, 0.1, 5], [0.9, 0, 5], [9, 0.3, 5]])
    assert rows(match_decisions(decisions, later)) == [0, 1, 2]
    assert rows(match_decisions(decisions[::-1], later)) == [2, 1, 0]
