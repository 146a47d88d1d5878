"""What people decide on the page: kept in memory, and in review.json before the page hears that it is kept."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, get_args

import numpy as np

from valuemap.dataset import Dataset
from valuemap.errors import InputError
from valuemap.map_folder import Map
from valuemap.review import Decision, Verdict, decide, match_decisions, read_review, state_of, write_review
from valuemap.viewer.scene import Scene, number

_LONGEST_TEXT = 2000
_ENTRIES = frozenset({"label_id", "verdict", "new_class", "moved_to", "note"})
"""What the page may say about a label."""


class Opinions:
    """The decisions about one map, in one file.

    Raises
    ------
    InputError
        The file cannot be used.
    """

    def __init__(self, scene: Scene, path: Path) -> None:
        self.path = path
        self._scene = scene
        self._lock = threading.Lock()
        self._decisions = read_review(path, self._map.frame)
        self._match()

    @property
    def _map(self) -> Map:
        return self._scene.result

    @property
    def _dataset(self) -> Dataset | None:
        return None if self._scene.evidence is None else self._scene.evidence.dataset

    def _match(self) -> None:
        matches = match_decisions(self._decisions, self._map, self._dataset)
        self._row_of: list[int] = matches.row_of_decision.tolist()
        # Each with the rejection that it is asked about for: without that one it is as any other label.
        self._unsure = {row: self._decisions[number] for row, number in matches.unsure.items()}

    def to_json(self) -> dict[str, Any]:
        """Return all decisions by the ids of this map, and those that are about nothing in it."""
        with self._lock:
            pairs = list(zip(self._decisions, self._row_of, strict=True))
            asked = self._asked()
        return {
            "decisions": [*(self._entry(decision, row) for decision, row in pairs if row >= 0), *asked],
            "without_label": [self._lost(decision) for decision, row in pairs if row < 0],
        }

    def _asked(self) -> list[dict[str, Any]]:
        """Return the labels that nobody decided on and that a rejection could be about as well."""
        ids = self._map.labels.label_id
        row_of = {id(decision): row for decision, row in zip(self._decisions, self._row_of, strict=True)}
        return [
            {"label_id": int(ids[row]), "state": "check again", "beside": int(ids[at]) if at >= 0 else None}
            for row, decision in sorted(self._unsure.items())
            if row not in self._row_of and (at := row_of.get(id(decision))) is not None
        ]

    def decide(self, wish: Any) -> dict[str, Any]:
        """Keep a decision that the page asks for, in place of an earlier one about the label; return it as kept.

        `wish` is {label_id, verdict, new_class?, moved_to?, note?}; without a verdict the label is open again.

        Raises
        ------
        InputError
            It cannot be understood, or there is no such label.
        OutputError
            The file cannot be written.
        """
        label_id, verdict, new_class, moved_to, note = _understand(wish)
        labels = self._map.labels
        row = int(np.searchsorted(labels.label_id, label_id))
        if row == len(labels) or labels.label_id[row] != label_id:
            raise InputError(f"there is no label {label_id} in the map", hint="load the page again")
        with self._lock:
            others = [(each, at) for each, at in zip(self._decisions, self._row_of, strict=True) if at != row]
            decision = None
            if verdict is not None:
                position = None
                if moved_to is not None:
                    at = self._scene.local(labels.position_in_world_m[row : row + 1])[0]
                    world = self._scene.world(np.array([[*moved_to, at[2]]]))[0]
                    position = (float(world[0]), float(world[1]), float(world[2]))
                decision = decide(
                    self._map,
                    label_id,
                    verdict,
                    dataset=self._dataset,
                    new_class=new_class,
                    new_position_in_world_m=position,
                    note=note,
                )
                others.append((decision, row))
            decisions, rows = [each for each, _ in others], [at for _, at in others]
            write_review(self.path, decisions, self._map.frame)
            self._decisions, self._row_of = decisions, rows
            asked = [each for each in self._asked() if each["label_id"] == label_id]
        if decision is not None:
            return self._entry(decision, row)
        return asked[0] if asked else {"label_id": label_id, "state": "open"}

    def _entry(self, decision: Decision, row: int) -> dict[str, Any]:
        labels = self._map.labels
        moved = decision.new_position_in_world_m
        return {
            "label_id": int(labels.label_id[row]),
            "state": state_of(decision, labels, row),
            "verdict": decision.verdict,
            "new_class": decision.new_class,
            "moved_to": None if moved is None else [number(c) for c in self._scene.local(np.array([moved]))[0][:2]],
            "note": decision.note,
            "votes_then": decision.votes,
        }

    def _lost(self, decision: Decision) -> dict[str, Any]:
        at = self._scene.local(np.array([decision.position_in_world_m]))[0]
        return {
            "label_id": decision.label_id,
            "verdict": decision.verdict,
            "class": decision.class_name,
            "note": decision.note,
            "local_m": [number(c) for c in at],
        }


def _understand(wish: Any) -> tuple[int, Verdict | None, str | None, tuple[float, float] | None, str]:
    hint = "load the page again"
    if not isinstance(wish, dict):
        raise InputError(f"expected a JSON object, found {type(wish).__name__}", hint=hint)
    if unknown := wish.keys() - _ENTRIES:
        known = ", ".join(sorted(_ENTRIES))
        raise InputError(f"expected {known}, found {', '.join(map(repr, sorted(unknown)))}", hint=hint)
    label_id, verdict, moved = wish.get("label_id"), wish.get("verdict"), wish.get("moved_to")
    new_class, note = wish.get("new_class"), wish.get("note", "")
    if not isinstance(label_id, int) or isinstance(label_id, bool) or abs(label_id) >= 2**63:
        raise InputError(f"label_id: expected a whole number, found {label_id!r}", hint=hint)
    if verdict is not None and verdict not in get_args(Verdict):
        raise InputError(f"verdict: expected one of {', '.join(get_args(Verdict))}, found {verdict!r}", hint=hint)
    for name, text in (("new_class", new_class or ""), ("note", note)):
        if not isinstance(text, str) or len(text) > _LONGEST_TEXT or "\0" in text:
            raise InputError(f"{name}: expected a text of at most {_LONGEST_TEXT} characters", hint=hint)
    if moved is None:
        return label_id, verdict, new_class or None, None, note
    is_pair = isinstance(moved, list) and len(moved) == 2
    if not is_pair or not all(isinstance(c, int | float) and np.isfinite(c) and abs(c) < 1e7 for c in moved):
        raise InputError(f"moved_to: expected two numbers in metres, found {moved!r}", hint=hint)
    return label_id, verdict, new_class or None, (float(moved[0]), float(moved[1])), note
