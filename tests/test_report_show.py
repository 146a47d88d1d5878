"""One label, one place: what is said about them, and that it is true."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from report_city import city, write_city
from small_dataset import map_of, small_dataset
from valuemap.arrays import Floats
from valuemap.cli.commands import app
from valuemap.errors import InputError
from valuemap.evidence import Evidence
from valuemap.map_folder import REJECTED, read_map, write_map
from valuemap.report.crops import chosen_voters, voter_crop
from valuemap.report.label_sheet import plot_label
from valuemap.report.place_sheet import explain_place, place_in_world, plot_place
from valuemap.report.style import save_figure
from valuemap.tables import Categories, Rejected, Votes
from valuemap.tables.map import REJECTION_REASONS
from valuemap.tables.read import read_table
from valuemap.tables.write import write_table


def rejected_at(point: np.ndarray[tuple[int], np.dtype[np.float64]], *reasons: str) -> Rejected:
    count = len(reasons)
    return Rejected(
        hypothesis_id=np.arange(1, count + 1),
        class_name=Categories.from_texts(["light"] * count),
        position_in_world_m=np.tile(point, (count, 1)) + np.arange(count)[:, None] * [0.3, 0.0, 0.0],
        votes=np.arange(count) + 2,
        passes=np.ones(count, np.int64),
        expected=np.full(count, 9),
        existence=np.where(np.arange(count) % 2 == 0, 0.31, np.nan),
        reason=Categories.from_texts(list(reasons)),
        rival=np.array([5] + [-1] * (count - 1)),
    )


# A label.


def small_label() -> int:
    """Return the label with the fewest votes of those that some image missed: its sheet is drawn the fastest."""
    labels = city().result.labels
    missed = [len(city().misses(int(label))) > 0 for label in labels.label_id]
    return int(labels.label_id[np.argmin(np.where(missed, labels.votes, 10**6))])


def three_votes() -> Evidence:
    """Return a label at the first object of the small dataset, with three votes of two passes."""
    votes = Votes(
        label_id=np.zeros(3, np.int64),
        detection_id=np.array([100, 101, 102]),
        image_id=np.array([10, 20, 30]),
        residual_px=np.array([1.0, 2.0, 3.0]),
        residual_sigmas=np.array([0.5, 1.0, 1.5]),
    )
    return Evidence(replace(map_of([[4.0, 25.0, 5.0]]), votes=votes), small_dataset())


def test_a_label_is_drawn_the_same_every_time(tmp_path: Path) -> None:
    evidence = three_votes()
    (tmp_path / "a").mkdir()
    Image.new("RGB", (640, 480), (40, 120, 200)).save(tmp_path / "a" / "1.jpg")
    for name in ("a.svg", "b.svg"):
        save_figure(plot_label(evidence, 0, tmp_path), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_the_sheet_says_who_voted_and_who_did_not() -> None:
    evidence, label = city(), small_label()
    voters, misses = evidence.voters(label), evidence.misses(label)
    texts = [text.get_text() for text in plot_label(evidence, label).texts]
    of_how_many = f"{len(voters)} of {len(voters) + len(misses)} images that should have"
    assert any(text.startswith(of_how_many) for text in texts)
    assert any(text.startswith(f"{len(misses)} image") and "did not vote" in text for text in texts)
    passes, count = np.unique(voters.pass_number, return_counts=True)
    assert 2 <= len(passes) <= 6
    for number, votes in zip(passes, count, strict=True):
        name = evidence.pass_name(int(voters.image_row[voters.pass_number == number][0]))
        assert any(text.startswith(f"Pass {name}: {votes} vote") for text in texts)


def test_a_label_without_votes_is_drawn() -> None:
    plot_label(Evidence(map_of([[4.0, 25.0, 5.0]]), small_dataset()), 0)
    with pytest.raises(InputError, match="there is no label 9"):
        plot_label(Evidence(map_of([]), small_dataset()), 9)


def test_a_crop_holds_its_box_and_its_point() -> None:
    evidence = city()
    for label in evidence.result.labels.label_id[:5]:
        voters = evidence.voters(int(label))
        for i in range(len(voters)):
            crop = voter_crop(evidence, None, voters, i, 120)
            for pixel in (voters.box_px[i] - voters.size_px[i] / 2, voters.box_px[i] + voters.size_px[i] / 2):
                assert np.all((crop.inside(pixel) >= 0.0) & (crop.inside(pixel) <= 120.0))
            point = crop.inside(voters.projected_px[i])
            assert np.all((point >= 0.0) & (point <= 120.0))


def test_crops_are_of_all_passes_before_any_has_two() -> None:
    evidence = city()
    voters = evidence.voters(int(evidence.result.labels.label_id[0]))
    passes = len(np.unique(voters.pass_number))
    assert passes >= 2
    assert len(np.unique(voters.pass_number[chosen_voters(voters, passes)])) == passes
    assert len(chosen_voters(voters, 10_000)) == len(voters)


# A place.


def test_where_nothing_looks_nothing_could_be_seen() -> None:
    answer = explain_place(city(), np.array([5000.0, 0.0, 0.0]), None)
    assert answer.reasons[0].startswith("No image pictures this place within 60 m")
    assert "keeps no rejected hypotheses" in answer.reasons[-1]


def test_where_a_label_is_it_is_named() -> None:
    labels = city().result.labels
    answer = explain_place(city(), labels.position_in_world_m[2] + [0.3, 0.0, -8.0], None)
    assert answer.reasons[0].startswith(f"There is a label: {labels.label_id[2]} ")
    assert "0.30 m away" in answer.reasons[0]
    assert answer.point_in_world_m[2] == pytest.approx(labels.position_in_world_m[2, 2])


def test_detections_of_other_labels_are_told_from_those_left_over() -> None:
    evidence = city()
    labels = evidence.result.labels
    # On the way from a camera to a label: its rays pass there.
    row = int(np.argmax(labels.votes))
    voters = evidence.voters(int(labels.label_id[row]))
    camera = evidence.center_in_world_m[voters.image_row[np.argmax(voters.distance_m)]]
    place = camera + 0.6 * (labels.position_in_world_m[row] - camera)
    answer = explain_place(evidence, place, None, radius_m=1.5)
    own = int(np.sum(answer.passing.label_id == labels.label_id[row]))
    assert own > 0
    assert any(f"for label {labels.label_id[row]}, " in reason for reason in answer.reasons)
    free = int(np.sum(answer.passing.label_id < 0))
    left_over = [reason for reason in answer.reasons if reason.endswith("for nothing.")]
    assert left_over == [] if free == 0 else left_over[0].startswith(f"{free} detection")
    assert answer.to_json()["of_them_without_a_label"] == free


def test_a_place_that_the_detector_never_marked_is_called_so() -> None:
    evidence = city()
    found = False
    for x in np.arange(-40.0, 200.0, 20.0):
        answer = explain_place(evidence, place_in_world(evidence, x, 3.0), None)
        if len(answer.looks) and not len(answer.passing):
            assert "the detector found nothing here" in answer.reasons[0]
            found = True
    assert found


def test_rejected_hypotheses_say_which_test_they_failed() -> None:
    evidence = city()
    point = place_in_world(evidence, 30.0, 12.0)
    rejected = rejected_at(point, *REJECTION_REASONS)
    answer = explain_place(evidence, point, rejected, radius_m=2.0)
    shown = [reason for reason in answer.reasons if reason.startswith("A hypothesis")]
    assert len(answer.hypotheses) == 7
    assert np.all(np.diff(rejected.votes[answer.hypotheses]) <= 0)
    for row, reason in zip(answer.hypotheses, shown, strict=False):
        assert REJECTION_REASONS[rejected.reason.texts()[row]] in reason
        assert f"{rejected.votes[row]} votes" in reason
        assert ("0.31" in reason) == bool(np.isfinite(rejected.existence[row]))
    assert not any("keeps no rejected" in reason for reason in answer.reasons)
    assert explain_place(evidence, point + [500.0, 0.0, 0.0], rejected).reasons[0].startswith("No rejected hypothesis")
    plot_place(evidence, answer, rejected)


def test_the_legend_of_a_place_explains_what_is_there_and_nothing_else() -> None:
    evidence = city()
    labels = evidence.result.labels

    def legend(point: Floats, rejected: Rejected | None = None) -> set[str]:
        figure = plot_place(evidence, explain_place(evidence, point, rejected), rejected)
        found = figure.axes[0].get_legend()
        assert found is not None
        return {text.get_text() for text in found.get_texts()}

    assert legend(np.array([5000.0, 0.0, 0.0])) == {"the place"}
    at_label = legend(labels.position_in_world_m[int(np.argmax(labels.votes))])
    assert {"labels", "rays that vote for labels", "the place"} <= at_label
    assert "rejected hypotheses" not in at_label
    point = place_in_world(evidence, 30.0, 12.0)
    assert "rejected hypotheses" in legend(point, rejected_at(point, "votes"))
    assert "rejected hypotheses" not in legend(point, rejected_at(point + [900.0, 0.0, 0.0], "votes"))


def test_a_place_is_at_the_height_of_what_was_rejected_there() -> None:
    evidence = city()
    point = place_in_world(evidence, 30.0, 12.0)
    rejected = rejected_at(point + [0.0, 0.0, 3.3], "votes")
    assert explain_place(evidence, point, rejected).point_in_world_m[2] == pytest.approx(point[2] + 3.3)


def test_rejected_hypotheses_are_read_from_the_folder_of_the_map(tmp_path: Path) -> None:
    write_map(map_of([[1.0, 2.0, 3.0]]), tmp_path)
    assert read_map(tmp_path).rejected is None
    write_table(rejected_at(np.zeros(3), "votes", "existence"), tmp_path / REJECTED)
    read = read_map(tmp_path).rejected
    assert read is not None
    assert read.reason.texts() == ["votes", "existence"]
    assert len(read_table(Rejected, tmp_path / REJECTED)) == 2
    (tmp_path / REJECTED).write_bytes(b"")
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_map(tmp_path)


# On the command line.


def command(*arguments: str | Path | int) -> int | str | None:
    """Run a command in this process; return its status."""
    with pytest.raises(SystemExit) as stopped:
        app(list(map(str, arguments)))
    return stopped.value.code


def test_show_and_report_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, result = write_city(tmp_path)
    assert command("show", result, small_label(), "--json", "--out", tmp_path / "l.svg") == 0
    assert json.loads(capsys.readouterr().out)["votes"] == len(city().voters(small_label()))
    assert command("show", result, "--at", "5000", "0", "--dataset", data, "--out", tmp_path / "p.png") == 0
    assert "nothing could be seen here" in capsys.readouterr().out
    assert imread(tmp_path / "p.png").shape[1] == 1600
    write_map(map_of([[1.0, 2.0, 3.0]]), tmp_path / "elsewhere" / "map")
    assert command("report", tmp_path / "elsewhere" / "map", "--out", tmp_path / "r.html") == 0
    assert "The dataset of the map was not given" in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "MAP"], "expected a label, or a place"),
        (["show", "MAP", "1", "--at", "0", "0"], "expected a label, or a place"),
        (["show", "MAP", "--lat", "1"], "expected a label, or a place"),
        (["show", "MAP", "1", "--radius", "5"], "around a place, not around a label"),
        (["show", "MAP", "--lat", "1", "--lon", "2"], "the map is not geo-referenced"),
        (["show", "MAP", "--lat", "91", "--lon", "1"], "--lat 91 --lon 1: expected a latitude from -90 to 90"),
        (["show", "MAP", "--lat", "1", "--lon", "nan"], "--lat 1 --lon nan: expected a latitude from -90 to 90"),
        (["show", "MAP", "--at", "nan", "1"], "--at nan 1: expected metres, at most 1e+09"),
        (["show", "MAP", "--at", "1", "inf"], "--at 1 inf: expected metres, at most 1e+09"),
        (["show", "MAP", "--at", "1", "nan"], "--at 1 nan: expected metres, at most 1e+09"),
        (["show", "MAP", "--at", "1e300", "1"], "--at 1e+300 1: expected metres, at most 1e+09"),
        (["show", "MAP", "999"], "there is no label 999"),
        (["show", "MAP", "1", "--out", "x.gif"], "cannot draw a file that ends in .gif"),
        (["report", "MAP", "--out", "x.pdf"], "a report is an HTML file"),
        (["report", "MAP", "--out", "x.html", "--passes", "none"], "no such file"),
        (["experiment", "passes", "DATA", "--out", "MAP"], "is a folder without experiment.json"),
    ],
)
def test_mistakes_get_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data, result = write_city(tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {"MAP": str(result), "DATA": str(data)}
    assert command(*(names.get(each, each) for each in arguments)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    error, hint = shown.err.strip().splitlines()
    assert error.startswith("error: ")
    assert message in error
    assert hint.startswith("hint: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset", "map"]
