"""Tables of a map itself: classes, what the run counted, settings, time and memory, its most doubtful labels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from valuemap.arrays import Ints
from valuemap.config import MapConfig
from valuemap.evaluate import Evaluation
from valuemap.map_folder import Map
from valuemap.report.errors import error_m, spread_m
from valuemap.report.paper import Cell, ReportTable

DOUBTFUL = 12
"""How many of the most doubtful labels, and of the worst, are listed."""


def run_tables(result: Map) -> list[ReportTable]:
    """Return the tables that need nothing but the map."""
    return [_classes(result), *_poses(result), _stages(result), _counts(result), _settings(result)]


def accuracy_tables(evaluation: Evaluation) -> list[ReportTable]:
    """Return the accuracy statement, completeness and what chance would give, as surveyors ask for them."""
    figures = evaluation.to_json()
    tables = []
    for name, title, notes in (
        ("accuracy", "Positional accuracy", (f"{_sentence(evaluation.accuracy.statement)}.",)),
        ("completeness", "Completeness", ()),
        ("chance", "What chance would give", ("The truth is moved aside, and labels are matched with it again.",)),
    ):
        rows = tuple((_readable(what), value) for what, value in _flat(figures[name]) if not isinstance(value, str))
        tables.append(ReportTable(name, title, ("", "value"), rows, notes))
    return tables


_UNITS = {"_m": "m", "_rad": "rad", "_px": "px", "_deg": "°"}
_SPELLINGS = {
    "rmse h": "RMSE, horizontal",
    "rmse v": "RMSE, vertical",
    "rmse 3d": "RMSE in space",
    "nssda horizontal 95": "NSSDA, horizontal, 95 %",
    "nssda vertical 95": "NSSDA, vertical, 95 %",
    "in 95 ellipse": "share in the 95 % ellipse",
    "in 95 ellipse less bias": "share in the 95 % ellipse, without the bias",
    "in 95 height": "share in the 95 % interval of the height",
    "in 95 height less bias": "share in the 95 % interval of the height, without the bias",
    "stated sigma factor": "true sigma over stated sigma",
}


def _readable(name: str) -> str:
    """Return the name of a figure for people: `rmse_h_m` is RMSE, horizontal (m)."""
    unit = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
    words = name.removesuffix(unit).replace("_", " ")
    words = _SPELLINGS.get(words, words.replace("rmse", "RMSE"))
    return f"{words} ({_UNITS[unit]})" if unit else words


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def doubtful_rows(result: Map) -> Ints:
    """Return the rows of the labels that exist with the least probability, else have the fewest votes; none is gone."""
    labels = result.labels
    order = np.lexsort((labels.label_id, labels.votes))
    if labels.existence is not None:
        order = np.lexsort((labels.label_id, labels.votes, labels.existence))
    return _that_are_there(result, order)


def _that_are_there(result: Map, order: Ints) -> Ints:
    return np.asarray(order[result.is_there[order]][:DOUBTFUL])


def worst_rows(result: Map, evaluation: Evaluation | None) -> Ints:
    """Return the rows of the worst labels that are there, the worst first.

    With truth: false ones and then duplicates, the surest first, then those farthest from their objects. Without:
    those with the largest uncertainty.
    """
    labels = result.labels
    if evaluation is None:
        return _that_are_there(result, np.lexsort((labels.label_id, -spread_m(result))))
    matches = evaluation.matches
    names = np.array(matches.label_outcome.names)
    rank = np.array([{"false": 0, "duplicate": 1}.get(name, 2) for name in names])[matches.label_outcome.codes]
    error = error_m(result, evaluation)
    sureness = labels.votes if labels.existence is None else labels.existence
    badness = np.where(np.isnan(error), sureness, error)
    return _that_are_there(result, np.lexsort((labels.label_id, -badness, rank)))


def label_table(name: str, title: str, result: Map, rows: Ints, evaluation: Evaluation | None) -> ReportTable:
    """Return a table of some labels."""
    labels = result.labels
    spread = spread_m(result)
    columns = ["label", "class", "votes", "passes", "existence", "sigma (m)", "reprojection rms (px)"]
    if labels.state is not None:
        columns.append("state")
    if evaluation is not None:
        columns += ["outcome", "error (m)"]
        outcome, error = evaluation.matches.label_outcome, error_m(result, evaluation)
    body: list[tuple[Cell, ...]] = []
    for row in rows:
        cells: list[Cell] = [
            int(labels.label_id[row]),
            labels.class_name.names[labels.class_name.codes[row]],
            int(labels.votes[row]),
            int(labels.passes[row]),
            None if labels.existence is None else float(labels.existence[row]),
            float(spread[row]),
            float(labels.reprojection_rms_px[row]),
        ]
        if labels.state is not None:
            cells.append(labels.state.names[labels.state.codes[row]])
        if evaluation is not None:
            cells += [outcome.names[outcome.codes[row]], None if math.isnan(error[row]) else float(error[row])]
        body.append(tuple(cells))
    return ReportTable(name, title, tuple(columns), tuple(body))


def _classes(result: Map) -> ReportTable:
    labels, is_there = result.labels, result.is_there
    rows: list[tuple[Cell, ...]] = []
    for code in np.unique(labels.class_name.codes[is_there]):
        of_class = is_there & (labels.class_name.codes == code)
        existence = None if labels.existence is None else float(np.median(labels.existence[of_class]))
        rows.append(
            (
                labels.class_name.names[code],
                int(of_class.sum()),
                float(np.median(labels.votes[of_class])),
                float(np.median(labels.passes[of_class])),
                existence,
                float(np.median(spread_m(result)[of_class])),
                float(np.median(labels.reprojection_rms_px[of_class])),
            )
        )
    rows.sort(key=lambda row: (-int(row[1] or 0), str(row[0])))
    columns = ("class", "labels", "votes", "passes", "existence", "sigma (m)", "reprojection rms (px)")
    return ReportTable(
        "classes", "Labels by class", columns, tuple(rows), ("Medians over the labels of a class.", *_gone(result))
    )


def _gone(result: Map) -> tuple[str, ...]:
    gone = int(np.sum(~result.is_there))
    be = "label that an update found to be gone is" if gone == 1 else "labels that an update found to be gone are"
    return (f"{gone:,} {be} left out.",) if gone else ()


def _poses(result: Map) -> list[ReportTable]:
    """Return what was found wrong with the poses of drives and with cameras, a row for each part of a drive."""
    record = result.run.get("poses")
    if not isinstance(record, dict) or record.get("found") != "faults":
        return []
    rows: list[tuple[Cell, ...]] = [
        (f"camera {camera['camera_id']}", "", None, *_turn_delay(camera), camera.get("focal_length_factor"))
        for camera in record.get("cameras", [])
    ]
    for drive in record.get("drives", []):
        whose = (f"drive {drive['drive']}", str(drive["pass"]))
        if "turned_deg" in drive or "delay_s" in drive:
            rows.append((*whose, None, *_turn_delay(drive), None))
        rows += [
            (*whose, _numbers(segment["moved_m"]), None, None, None)
            for segment in drive.get("segments", [])
            if "moved_m" in segment
        ]
    columns = (
        "",
        "pass",
        "moved east, north, up (m)",
        "turned right, down, forward (deg)",
        "delay (s)",
        "focal length x",
    )
    notes = ("What was wrong with poses and cameras, told by the objects that drives see, and put right.",)
    return [ReportTable("poses", "Corrections of poses", columns, tuple(rows), notes)]


def _turn_delay(found: dict[str, Any]) -> tuple[Cell, Cell]:
    return _numbers(found["turned_deg"]) if "turned_deg" in found else None, found.get("delay_s")


def _numbers(values: list[float]) -> str:
    return "  ".join(f"{value:.2f}" for value in values)


def _stages(result: Map) -> ReportTable:
    stages = [stage for stage in result.run.get("stages", []) if isinstance(stage, dict)]
    rows: list[tuple[Cell, ...]] = [
        (str(stage.get("stage", "?")), stage.get("seconds"), stage.get("peak_memory_mb")) for stage in stages
    ]
    if rows:
        seconds = [float(row[1]) for row in rows if isinstance(row[1], int | float)]
        memory = [int(row[2]) for row in rows if isinstance(row[2], int | float)]
        rows.append(("all", sum(seconds), max(memory, default=None)))
    columns = ("stage", "seconds", "peak memory so far (MB)")
    return ReportTable("stages", "Where time and memory went", columns, tuple(rows))


def _counts(result: Map) -> ReportTable:
    rows = tuple((_readable(name), value) for name, value in _flat(result.run.get("counts", {})) if value is not None)
    return ReportTable("counts", "What the run counted", ("", "value"), rows)


def _settings(result: Map) -> ReportTable:
    defaults = MapConfig().as_dict()
    not_given = set(result.run.get("settings_not_given", ()))

    def said(name: str, value: Cell) -> str:
        if name in not_given:
            return "" if value is None else "usual" if result.method == "paper" else "estimated"
        return "" if defaults.get(name, value) == value else "changed"

    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (name, "estimated" if value is None else value, said(name, value))
        for name, value in _flat(result.run.get("settings", {}))
    )
    return ReportTable("settings", "Settings of the run", ("setting", "value", ""), rows)


def _flat(record: Any, prefix: str = "") -> list[tuple[str, Cell]]:
    """Return what a record holds by name, nested names joined."""
    flat: list[tuple[str, Cell]] = []
    for name, value in record.items() if isinstance(record, dict) else ():
        if isinstance(value, dict):
            flat += _flat(value, f"{prefix}{name} ")
        else:
            flat.append((f"{prefix}{name}", value if isinstance(value, int | float | str | None) else str(value)))
    return flat
