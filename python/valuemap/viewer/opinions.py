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
        rows = match_decisions(self._decisions, self._map, self._dataset)
        self._row_of = rows.tolist()

    def to_json(self) -> dict[str, Any]:
        """Return all decisions by the ids of this map, and those that are about nothing in it."""
        with self._lock:
            pairs = list(zip(self._decisions, self._row_of, strict=True))
        return {
            "decisions": [self._entry(decision, row) for decision, row in pairs if row >= 0],
            "without_label": [self._lost(decision) for decision, row in pairs if row < 0],
        }

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
        return {"label_id": label_id, "state": "open"} if decision is None else self._entry(decision, row)

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
