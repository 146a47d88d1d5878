"""What people decided about labels, kept so that it survives a new map of the same place.

A decision is about a place in the world, not about a row of a table: ids change when a map is made again. So every
decision remembers the label as it was: id, class, position, covariance, how much evidence it had, which boxes voted
for it, and which other labels stood around it. `match_decisions` finds the label of a new map that each decision is
about. A neighbour that stood beside a rejected label takes its own label again, so that of two heads on one pole the
right one stays rejected. A label that a rejection could be about as well, and that nothing else accounts for, is asked
about.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from valuemap.arrays import Floats, Ints, runs
from valuemap.assignment import one_to_one
from valuemap.connected import connected
from valuemap.dataset import Dataset, Frame, evenly, rows_of
from valuemap.errors import InputError
from valuemap.folders import new_file
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.nearby import ONE_PLACE_CHI2
from valuemap.tables import Categories, Labels
from valuemap.tables.covariance import covariance_matrices

Verdict = Literal["accepted", "rejected", "noted"]
State = Literal["open", "accepted", "rejected", "check again"]

_FORMAT_VERSION = 1
_POSITION_FLOOR_M = 0.5
"""Standard deviation per axis by which a label may move between two maps on top of its covariances: other passes, other
pose errors."""
_SAME_VOTERS = 0.5
"""A label with this share of the voters that were decided on, as far as their images are still there, is the same one,
wherever it is and whatever its class."""
_PART_OF_VOTERS = 0.25
"""A label with this share of the boxes that voted for a rejected one is in part what was rejected."""
_LEAST_VOTERS = 3
"""Fewer of the boxes that voted then say nothing, unless there were no more."""
_VOTERS_PRICE = 9.0
"""What it costs, in squared sigmas, to be taken for a label whose voters all vote for another one now."""
_KEPT_VOTERS = 24
_NEIGHBOR_M = 6.0
_CHECK_AGAIN = 2.0
"""How many times the votes it was rejected with a label must have to be shown for another decision."""

_Point = tuple[float, float, float]


@dataclass(frozen=True)
class Decision:
    """What somebody decided about a label, and what that label was at that time.

    Positions are in metres in the frame of the map, the covariance as xx, xy, xz, yy, yz, zz in m². `voters` are some
    of the boxes that voted: name of the image and centre in px. `neighbors` are the positions of other labels around
    it, relative to it. `new_class` and `new_position_in_world_m` are corrections.
    """

    label_id: int
    verdict: Verdict
    class_name: str
    position_in_world_m: _Point
    covariance_m2: tuple[float, ...]
    votes: int
    passes: int
    existence: float | None = None
    voters: tuple[tuple[str, float, float], ...] = ()
    neighbors: tuple[_Point, ...] = ()
    new_class: str | None = None
    new_position_in_world_m: _Point | None = None
    note: str = ""


@dataclass(frozen=True)
class Matches:
    """Which labels of a map decisions are about.

    `row_of_decision` (decisions) is the row of the label that each is about, -1 where the map has none. `unsure` has
    the rows of labels that a rejection could be about as well, and that nothing else accounts for (no other decision,
    and no label that stood there then, unless boxes and places disagree which of the two it is), or that have a quarter
    of the boxes that voted for what was rejected. To each belongs the number of that decision.
    """

    row_of_decision: Ints
    unsure: dict[int, int]


@dataclass(frozen=True)
class Reviewed:
    """What became of the labels of a map (`apply_review`): counts, and the ids to look at again."""

    accepted: int
    rejected: int
    check_again: tuple[int, ...]
    without_label: int
    """Decisions about something that the map does not hold."""


def decide(
    result: Map,
    label_id: int,
    verdict: Verdict,
    *,
    dataset: Dataset | None = None,
    new_class: str | None = None,
    new_position_in_world_m: _Point | None = None,
    note: str = "",
) -> Decision:
    """Return a decision about a label of a map, with all that is needed to know it again.

    With the dataset it also remembers who voted, which is what knows a label again that moved far.

    Raises
    ------
    InputError
        There is no such label.
    """
    labels = result.labels
    found = np.flatnonzero(labels.label_id == label_id)
    if not len(found):
        raise InputError(f"there is no label {label_id} in the map", hint="valuemap info says how many there are")
    row = int(found[0])
    position = labels.position_in_world_m[row]
    away = labels.position_in_world_m - position
    distance = np.linalg.norm(away, axis=1)
    around = np.flatnonzero((distance <= _NEIGHBOR_M) & (np.arange(len(labels)) != row))
    around = around[np.argsort(distance[around], kind="stable")]
    return Decision(
        label_id=label_id,
        verdict=verdict,
        class_name=labels.class_name.names[labels.class_name.codes[row]],
        position_in_world_m=_point(position),
        covariance_m2=tuple(float(part) for part in labels.covariance_m2[row]),
        votes=int(labels.votes[row]),
        passes=int(labels.passes[row]),
        existence=None if labels.existence is None else float(labels.existence[row]),
        voters=() if dataset is None else _voters(result, dataset, label_id),
        neighbors=tuple(_point(each) for each in away[around]),
        new_class=new_class,
        new_position_in_world_m=new_position_in_world_m,
        note=note,
    )


def match_decisions(decisions: Sequence[Decision], result: Map, dataset: Dataset | None = None) -> Matches:
    """Return the label that each decision is about, and the labels that a rejection could be about as well.

    A label can be the one if it has the same class and is where that one was, given the covariances of both, or if most
    of the boxes that voted then, and whose images are there, vote for it now; of two labels at the place it is more
    probably the one that has these boxes. Of all ways to give labels to decisions and to the neighbours that
    they remember, each at most once, the one with the smallest sum of squared distances in sigmas counts. Nothing
    depends on the order of the decisions or on the ids of the labels.

    Where one label was rejected and two stand in its place now, one of them is the rejected one, and what the other is
    nobody has said: it is to be asked about, not shown as new.
    """
    labels = result.labels
    row_of_decision = np.full(len(decisions), -1)
    if not decisions or not len(labels):
        return Matches(row_of_decision, {})
    shares = _shares_of_voters(decisions, result, dataset)
    cost: dict[tuple[int, int], float] = {}
    price_of_place: dict[tuple[int, int], float] = {}
    for claimant, row, price in _claims_of_places(decisions, labels):
        price_of_place[claimant, row] = price
        share = shares[claimant] if claimant < len(decisions) else {}
        # Beside the label that its voters vote for now, another one is the less likely the fewer of them it has.
        cost[claimant, row] = price + _VOTERS_PRICE * (max(share.values(), default=0.0) - share.get(row, 0.0))
    for claimant, share in enumerate(shares):
        for row, part in share.items():
            if part >= _SAME_VOTERS:
                cost[claimant, row] = min(ONE_PLACE_CHI2 * (1.0 - part), cost.get((claimant, row), math.inf))
    assigned = _assign(cost)
    for claimant, row in assigned:
        if claimant < len(decisions):
            row_of_decision[claimant] = row
    unsure: dict[int, int] = {}
    row_of, holder_of = dict(assigned), {row: claimant for claimant, row in assigned}
    for claimant, row in sorted(cost, key=lambda claim: (cost[claim], claim)):
        if claimant >= len(decisions) or decisions[claimant].verdict != "rejected" or row_of.get(claimant) == row:
            continue
        holder = holder_of.get(row)
        is_neighbor = holder is not None and holder >= len(decisions)
        # A neighbour has it because of the boxes; where the two stand says that each has the other's.
        if holder is None or (is_neighbor and _cost_of_exchange(price_of_place, row_of, claimant, holder) < 0.0):
            unsure.setdefault(row, claimant)
    decided = set(row_of_decision.tolist())
    for claimant, share in enumerate(shares):
        for row, part in share.items():
            if part >= _PART_OF_VOTERS and row not in decided and decisions[claimant].verdict == "rejected":
                unsure.setdefault(row, claimant)
    return Matches(row_of_decision, unsure)


def state_of(decision: Decision, labels: Labels, row: int) -> State:
    """Return what a decision makes of a label: one that was rejected and has twice the votes now is to be looked at."""
    if decision.verdict == "rejected":
        return "check again" if labels.votes[row] >= _CHECK_AGAIN * decision.votes else "rejected"
    return "accepted" if decision.verdict == "accepted" else "open"


def apply_review(result: Map, decisions: Sequence[Decision], dataset: Dataset | None = None) -> tuple[Map, Reviewed]:
    """Return the map without what was rejected, with classes and positions as people corrected them.

    A label that is to be looked at again stays out until somebody did.
    """
    labels = result.labels
    matches = match_decisions(decisions, result, dataset)
    rows = matches.row_of_decision
    state: list[State] = ["open"] * len(labels)
    for row in matches.unsure:
        state[row] = "check again"
    classes, position = labels.class_name.texts(), labels.position_in_world_m.copy()
    for decision, row in zip(decisions, rows, strict=True):
        if row < 0:
            continue
        state[row] = state_of(decision, labels, int(row))
        classes[row] = decision.new_class or classes[row]
        if decision.new_position_in_world_m is not None:
            position[row] = decision.new_position_in_world_m
    moved = np.flatnonzero(np.any(position != labels.position_in_world_m, axis=1))
    lon_lat_height = labels.lon_lat_height
    if len(moved) and lon_lat_height is not None and result.frame.anchor is not None:
        lon_lat_height = lon_lat_height.copy()
        lon_lat_height[moved] = lon_lat_height_from_enu(position[moved], result.frame.anchor)
    keep = np.array([each in ("open", "accepted") for each in state], dtype=np.bool_)
    corrected = labels.replace(
        class_name=Categories.from_texts(classes), position_in_world_m=position, lon_lat_height=lon_lat_height
    )
    outcome = Reviewed(
        accepted=state.count("accepted"),
        rejected=state.count("rejected"),
        check_again=tuple(int(labels.label_id[row]) for row, each in enumerate(state) if each == "check again"),
        without_label=int(np.sum(rows < 0)),
    )
    return replace(result, labels=corrected).take(keep), outcome


# On disk


def write_review(path: str | Path, decisions: Sequence[Decision], frame: Frame) -> None:
    """Write decisions as JSON, by place; an older file is replaced, never half.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    ordered = sorted(decisions, key=lambda each: (each.position_in_world_m, each.label_id))
    content = {
        "format_version": _FORMAT_VERSION,
        "frame": frame.to_json(),
        "decisions": [_to_json(decision, frame) for decision in ordered],
    }
    with new_file(Path(path), force=True) as temporary:  # What is there was read before, and is in it.
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def read_review(path: str | Path, frame: Frame) -> list[Decision]:
    """Read decisions into the frame of a map; none where there is no such file.

    Geo-referenced decisions are read into any geo-referenced map, whatever its anchor.

    Raises
    ------
    InputError
        The file is damaged, or its decisions were made in another frame that nobody can relate to the map's.
    """
    path = Path(path)
    if not path.is_file():
        return []
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))  # Some editors put a mark before it.
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}", hint="repair it, or move it away") from error
    if not isinstance(content, dict) or content.get("format_version") != _FORMAT_VERSION:
        found = content.get("format_version") if isinstance(content, dict) else type(content).__name__
        raise InputError(
            f"{path}: format_version: expected {_FORMAT_VERSION}, found {found}",
            hint="is this a review.json that valuemap view wrote?",
        )
    written_in = Frame.from_json(content.get("frame"), source=str(path))
    if written_in.is_georeferenced != frame.is_georeferenced:
        raise InputError(
            f"{path}: its decisions are {_kind(written_in)}, the map is {_kind(frame)}",
            hint="give the review.json of a map of the same place, or move this one away",
        )
    entries = content.get("decisions")
    if not isinstance(entries, list):
        raise InputError(f"{path}: decisions: expected a list", hint="repair it, or move it away")
    decisions = [_from_json(entry, f"{path}: decision {number}") for number, entry in enumerate(entries, start=1)]
    return _moved_to(_once_each(decisions, path), written_in, frame)


def _once_each(decisions: list[Decision], path: Path) -> list[Decision]:
    """Return decisions without those that are there twice, as where files of two people were put together.

    Raises
    ------
    InputError
        Two decisions about one label say different things.
    """
    first: dict[tuple[int, str, _Point], int] = {}
    for number, each in enumerate(decisions):
        other = first.setdefault((each.label_id, each.class_name, each.position_in_world_m), number)
        if decisions[other] != each:
            raise InputError(
                f"{path}: decisions {other + 1} ({decisions[other].verdict}) and {number + 1} ({each.verdict}) are "
                f"both about label {each.label_id} and differ",
                hint="keep the one that is right",
            )
    return [decisions[number] for number in first.values()]


def _kind(frame: Frame) -> str:
    return "geo-referenced" if frame.is_georeferenced else "in a frame of its own"


def _to_json(decision: Decision, frame: Frame) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "label_id": decision.label_id,
        "verdict": decision.verdict,
        "class": decision.class_name,
        "position_m": list(decision.position_in_world_m),
    }
    if frame.anchor is not None:  # For people and other software; the position counts.
        entry["lon_lat_height"] = _lon_lat_height(decision.position_in_world_m, frame.anchor)
    entry |= {
        "covariance_m2": list(decision.covariance_m2),
        "votes": decision.votes,
        "passes": decision.passes,
        "existence": decision.existence,
        "new_class": decision.new_class,
        "new_position_m": decision.new_position_in_world_m and list(decision.new_position_in_world_m),
        "note": decision.note,
        "neighbors_m": [list(each) for each in decision.neighbors],
        "voters": [list(each) for each in decision.voters],
    }
    return entry


def _lon_lat_height(position: _Point, anchor: _Point) -> list[float]:
    return [float(part) for part in lon_lat_height_from_enu(np.array([position]), anchor)[0]]


def _from_json(entry: Any, where: str) -> Decision:
    try:
        moved, existence, new_class = entry.get("new_position_m"), entry.get("existence"), entry.get("new_class")
        decision = Decision(
            label_id=int(entry["label_id"]),
            verdict=entry["verdict"],
            class_name=str(entry["class"]),
            position_in_world_m=_point(entry["position_m"]),
            covariance_m2=tuple(float(part) for part in entry["covariance_m2"]),
            votes=int(entry["votes"]),
            passes=int(entry["passes"]),
            existence=None if existence is None else float(existence),
            voters=tuple((str(name), float(x), float(y)) for name, x, y in entry.get("voters", [])),
            neighbors=tuple(_point(each) for each in entry.get("neighbors_m", [])),
            new_class=None if new_class is None else str(new_class),
            new_position_in_world_m=None if moved is None else _point(moved),
            note=str(entry.get("note", "")),
        )
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
        raise InputError(f"{where}: cannot be used: {error!r}", hint="repair or remove it") from error
    corrected = decision.new_position_in_world_m or ()
    numbers = (*decision.position_in_world_m, *decision.covariance_m2, *corrected)
    if decision.verdict not in get_args(Verdict) or len(decision.covariance_m2) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            f"{where}: expected a verdict ({', '.join(get_args(Verdict))}), positions and six covariances, found "
            f"{decision.verdict!r}, {[*decision.position_in_world_m, *corrected]}, {list(decision.covariance_m2)}",
            hint="repair or remove it",
        )
    return decision


def _moved_to(decisions: list[Decision], source: Frame, target: Frame) -> list[Decision]:
    """Return decisions that were made at another anchor in the frame of this one."""
    if source.anchor is None or target.anchor is None or source.anchor == target.anchor or not decisions:
        return decisions
    there, here = source.anchor, target.anchor

    def move(points: Sequence[_Point]) -> Floats:
        return enu_from_lon_lat_height(lon_lat_height_from_enu(np.array(points), there), here)

    position = move([each.position_in_world_m for each in decisions])
    corrected = move([each.new_position_in_world_m or each.position_in_world_m for each in decisions])
    return [
        replace(
            each,
            position_in_world_m=_point(position[i]),
            new_position_in_world_m=None if each.new_position_in_world_m is None else _point(corrected[i]),
        )
        for i, each in enumerate(decisions)
    ]


# Who is who


def _claims_of_places(decisions: Sequence[Decision], labels: Labels) -> list[tuple[int, int, float]]:
    """Return who may have which label by place: claimant, row, squared distance in sigmas.

    Claimants are the decisions, then their neighbours; a neighbour that is itself decided on is not asked twice.
    """
    from scipy.spatial import cKDTree  # Slow to import, and only reviews need it.

    centers, covariances, classes = [], [], []
    for each in decisions:
        centers.append(np.array(each.position_in_world_m))
        covariances.append(covariance_matrices(each.covariance_m2))
        classes.append(labels.class_name.code_of(each.class_name))
    decided = cKDTree(np.array(centers))
    known: set[_Point] = set()
    for each in decisions:
        for offset in each.neighbors:
            place = np.array(each.position_in_world_m) + offset
            key = _point(np.round(place, 3))
            if key not in known and not decided.query_ball_point(place, 1e-3):
                known.add(key)
                centers.append(place)
                covariances.append(np.zeros((3, 3)))
                classes.append(_ANY_CLASS)
    tree = cKDTree(labels.position_in_world_m)
    largest_label_m2 = float(np.max(labels.covariance_m2[:, [0, 3, 5]].sum(axis=1)))
    claims = []
    for claimant, (center, covariance, code) in enumerate(zip(centers, covariances, classes, strict=True)):
        reach = math.sqrt(ONE_PLACE_CHI2 * (float(np.trace(covariance)) + largest_label_m2 + _POSITION_FLOOR_M**2))
        rows = np.array(sorted(tree.query_ball_point(center, reach)), dtype=np.int64)
        if code != _ANY_CLASS:
            rows = rows[labels.class_name.codes[rows] == code]
        for row in rows:
            away = labels.position_in_world_m[row] - center
            spread = covariance + covariance_matrices(labels.covariance_m2[row]) + _POSITION_FLOOR_M**2 * np.eye(3)
            price = float(away @ np.linalg.solve(spread, away))
            if price <= ONE_PLACE_CHI2:
                claims.append((claimant, int(row), price))
    return claims


_ANY_CLASS = -2


def _shares_of_voters(decisions: Sequence[Decision], result: Map, dataset: Dataset | None) -> list[dict[int, float]]:
    """Return which part of the boxes that voted then votes for which label now, by its row, for each decision.

    Boxes in images that the dataset of the new map does not have say nothing.
    """
    shares: list[dict[int, float]] = [{} for _ in decisions]
    names = {name for each in decisions for name, _, _ in each.voters}
    if dataset is None or not names:
        return shares
    images, detections, votes, labels = dataset.images, dataset.detections, result.votes, result.labels
    image_names = images.name.to_pylist()
    image_row = rows_of(votes.image_id, images.image_id)
    is_named = np.array([name in names for name in image_names], dtype=np.bool_)
    label_of_voter: dict[tuple[str, float, float], int] = {}
    for vote in np.flatnonzero(is_named[image_row]):
        center = detections.center_px[rows_of(votes.detection_id[vote : vote + 1], detections.detection_id)[0]]
        label_of_voter[_voter(image_names[image_row[vote]], center)] = int(
            np.searchsorted(labels.label_id, votes.label_id[vote])
        )
    there = names.intersection(image_names)
    for share, each in zip(shares, decisions, strict=True):
        present = [voter for voter in each.voters if voter[0] in there]
        if len(present) < min(_LEAST_VOTERS, len(each.voters)):
            continue
        found = [label_of_voter[voter] for voter in present if voter in label_of_voter]
        share.update({row: found.count(row) / len(present) for row in sorted(set(found))})
    return shares


def _assign(cost: dict[tuple[int, int], float]) -> list[tuple[int, int]]:
    """Return pairs (claimant, row), each at most once, of the least total cost; to have none costs the gate."""
    if not cost:
        return []
    pairs = sorted(cost)
    claimant, row = np.array(pairs, np.int64).T
    price = np.array([cost[pair] for pair in pairs])
    # What has nothing to do with each other is assigned by itself.
    after = int(claimant.max()) + 1
    group = connected(claimant, after + row, after + int(row.max()) + 1)[claimant]
    order = np.argsort(group, kind="stable")
    assigned: list[tuple[int, int]] = []
    for together in runs(order, group[order]):
        mine, theirs = one_to_one(claimant[together], row[together], price[together], ONE_PLACE_CHI2)
        assigned += zip(mine.tolist(), theirs.tolist(), strict=True)
    return assigned


def _cost_of_exchange(
    price: dict[tuple[int, int], float], row_of: dict[int, int], claimant: int, neighbor: int
) -> float:
    """Return how much more it costs, in squared sigmas, if two claimants had each other's labels."""
    mine, other = row_of.get(claimant), row_of[neighbor]

    def of(who: int, row: int | None) -> float:
        return ONE_PLACE_CHI2 if row is None else price.get((who, row), ONE_PLACE_CHI2)

    return of(claimant, other) + of(neighbor, mine) - of(claimant, mine) - of(neighbor, other)


def _voters(result: Map, dataset: Dataset, label_id: int) -> tuple[tuple[str, float, float], ...]:
    """Return the boxes that voted for a label, some of them evenly where there are many."""
    votes = result.votes
    rows = evenly(np.flatnonzero(votes.label_id == label_id), _KEPT_VOTERS)
    detection_row = rows_of(votes.detection_id[rows], dataset.detections.detection_id)
    image_row = rows_of(votes.image_id[rows], dataset.images.image_id)
    return tuple(
        _voter(dataset.images.name[int(image)].as_py(), dataset.detections.center_px[detection])
        for image, detection in zip(image_row, detection_row, strict=True)
    )


def _voter(image_name: str, center_px: Floats) -> tuple[str, float, float]:
    return image_name, round(float(center_px[0]), 1), round(float(center_px[1]), 1)


def _point(values: Any) -> _Point:
    x, y, z = (float(each) for each in values)
    return x, y, z
