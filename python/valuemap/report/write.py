"""`valuemap report`: everything about a map in one page, with its figures and tables as files beside it."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from valuemap.arrays import Ints
from valuemap.dataset import Dataset, expect_dataset
from valuemap.evaluate import Evaluation
from valuemap.evidence import PICTURES, Evidence
from valuemap.experiment import PassesResult
from valuemap.folders import new_file, new_folder
from valuemap.map_folder import Map, expect_map
from valuemap.progress import Progress, silent
from valuemap.report import figures
from valuemap.report.above import plot_map
from valuemap.report.crops import chosen_voters, thumbnail, voter_crop
from valuemap.report.errors import error_m, spread_m
from valuemap.report.figures import ReportFigure, curve_name
from valuemap.report.page import Card, Content, inline_data, page_text
from valuemap.report.paper import Cell, ReportTable, paper_tables
from valuemap.report.run_tables import (
    accuracy_tables,
    doubtful_rows,
    label_table,
    run_tables,
    worst_rows,
)
from valuemap.report.style import FORMATS, probability

FILES_MARKER = "report.json"

_CROP_PX = 112
_CROPS_PER_LABEL = 4
_MOST_CROPS = 1200
"""Crops of all labels together: about 5 MB of the page."""


def files_folder(page: Path) -> Path:
    """Return the folder beside a page that holds its figures and tables."""
    return page.with_name(f"{page.stem}_files")


def write_report(
    result: Map,
    page: Path,
    *,
    dataset: Dataset | None = None,
    dataset_folder: Path | None = None,
    evaluation: Evaluation | None = None,
    passes: PassesResult | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> None:
    """Write the report of a map as `page`, and its figures (PNG, SVG) and tables (CSV) into a folder beside it.

    Parameters
    ----------
    result
        The map.
    page
        The HTML file to write; the folder beside it is called like it, with `_files`.
    dataset
        What the map was made from: without it there are no streets, rays, residuals by depth and paper's tables.
    dataset_folder
        The folder of the dataset: its pictures, if it has some, give the crops.
    evaluation
        The comparison with known objects.
    passes
        The result of `valuemap experiment passes`.
    force
        Replace files that valuemap did not write, too.
    progress
        Called as progress(what, done, total).

    Raises
    ------
    InputError
        The map was not made from this dataset.
    OutputError
        A place cannot be written, or is somebody else's.
    """
    expect_map(result)
    if dataset is not None:
        expect_dataset(dataset)
    evidence = None if dataset is None else Evidence(result, dataset)
    steps = 5
    progress("drawing the report", 0, steps)
    above = _above(result, dataset, evaluation)
    drawn = _figures(result, evidence, evaluation, passes)
    progress("drawing the report", 1, steps)
    doubtful, worst = doubtful_rows(result), worst_rows(result, evaluation)
    tables = _tables(result, dataset, evaluation, passes)
    of_labels = [
        label_table("doubtful", "The most doubtful labels", result, doubtful, evaluation),
        label_table("worst", "The worst labels", result, worst, evaluation),
    ]
    progress("drawing the report", 2, steps)
    pictures = None if dataset_folder is None else dataset_folder / PICTURES
    crops = {} if evidence is None else _crops(evidence, pictures, [*worst, *doubtful])
    progress("drawing the report", 3, steps)
    listed = {int(row) for row in [*worst, *doubtful]}
    data, details = inline_data(
        result, evidence, evaluation, {row: each for row, each in crops.items() if row not in listed}
    )
    content = Content(
        title=_name(result, dataset),
        summary=_summary(result, dataset),
        figures_in_short=tuple(_in_short(result, dataset, evaluation)),
        above=above,
        figures=tuple(drawn),
        tables=tuple(tables),
        lists=_lists(result, worst, doubtful, evaluation, crops),
        notes=tuple(_notes(result, dataset, evidence, evaluation, passes, crops)),
        data=data,
        details=details,
    )
    with new_folder(files_folder(page), parts=(FILES_MARKER,), part_folders=("",), force=force) as folder:
        names = _write_files(folder, [above, *drawn], [*tables, *of_labels])
        record = {"valuemap": version("valuemap"), "page": page.name, "files": names}
        (folder / FILES_MARKER).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    progress("drawing the report", 4, steps)
    with new_file(page, force=force) as temporary:
        temporary.write_text(page_text(content), encoding="utf-8")
    progress("drawing the report", steps, steps)


def write_csv_table(table: ReportTable, path: Path) -> None:
    """Write a table as CSV; texts that a spreadsheet would take for formulas are marked as texts."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([_as_text(name) for name in table.columns])
        writer.writerows([_as_text(cell) for cell in row] for row in table.rows)


def _as_text(cell: Cell) -> Cell:
    if cell is None:
        return ""
    if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return f"'{cell}"
    return cell


def _write_files(folder: Path, drawn: Iterable[ReportFigure], tables: Iterable[ReportTable]) -> list[str]:
    for figure in drawn:
        for suffix in FORMATS:
            (folder / f"{figure.name}{suffix}").write_bytes(figure.file(suffix))
    for table in tables:
        write_csv_table(table, folder / f"{table.name}.csv")
    return sorted(path.name for path in folder.iterdir())


# What the page holds.


def _above(result: Map, dataset: Dataset | None, evaluation: Evaluation | None) -> ReportFigure:
    matches = None if evaluation is None else evaluation.matches
    return ReportFigure(
        "map",
        "The map from above",
        "All labels, the busiest place, and in it the closest labels with the ellipses that hold them with 95 %.",
        plot_map(result, dataset, matches),
    )


def _figures(
    result: Map, evidence: Evidence | None, evaluation: Evaluation | None, passes: PassesResult | None
) -> list[ReportFigure]:
    drawn = [
        None if passes is None else figures.passes(passes),
        figures.existence(result, evaluation),
        figures.covariance(result, evaluation),
        None if evidence is None else figures.residuals_by_depth(evidence),
        figures.stages(result),
    ]
    return [figure for figure in drawn if figure is not None]


def _tables(
    result: Map, dataset: Dataset | None, evaluation: Evaluation | None, passes: PassesResult | None
) -> list[ReportTable]:
    tables = [] if dataset is None else paper_tables(result, dataset, evaluation)
    tables += accuracy_tables(evaluation) if evaluation is not None else []
    tables += run_tables(result)
    tables += [_passes_table(passes)] if passes is not None else []
    return tables


def _lists(
    result: Map,
    worst: Ints,
    doubtful: Ints,
    evaluation: Evaluation | None,
    crops: dict[int, list[tuple[str, str]]],
) -> tuple[tuple[str, str, tuple[Card, ...]], ...]:
    """Return title, explanation and labels of both lists; each label is listed once."""
    of_worst = (
        "Labels that match no object and duplicates, the surest first, then those farthest from their objects."
        if evaluation is not None
        else "Labels whose positions are the least certain."
    )
    of_doubtful = (
        "Labels with the least probability of existence, apart from those above."
        if result.labels.existence is not None
        else "Labels with the fewest votes, apart from those above."
    )
    others = doubtful[~np.isin(doubtful, worst)]
    return (
        ("The worst", of_worst, tuple(_cards(result, worst, evaluation, crops))),
        ("The most doubtful", of_doubtful, tuple(_cards(result, others, evaluation, crops))),
    )


def _passes_table(passes: PassesResult) -> ReportTable:
    rows = tuple(
        (curve_name(name), each.passes, each.clusters, each.lower, each.median, each.upper)
        for name, curve in passes.curves.items()
        for each in curve
    )
    return ReportTable(
        "passes",
        "What more passes bring",
        ("measure", "passes", "clusters", "lower quartile", "median", "upper quartile"),
        rows,
    )


def _name(result: Map, dataset: Dataset | None) -> str:
    return dataset.name if dataset is not None else str(result.run.get("dataset", "A map"))


def _summary(result: Map, dataset: Dataset | None) -> str:
    of_what = (
        f" of {len(dataset.detections):,} detections in {len(dataset.images):,} images" if dataset is not None else ""
    )
    return f"Map{of_what}, by valuemap {result.run.get('valuemap', '?')}, method {result.method}"


def _in_short(result: Map, dataset: Dataset | None, evaluation: Evaluation | None) -> Iterable[tuple[str, str]]:
    is_there = result.is_there
    labels, gone = result.labels, int(np.sum(~is_there))
    yield f"{len(labels) - gone:,}", "labels"
    if gone:
        yield f"{gone:,}", "labels that are gone, not counted"
    if dataset is not None:
        yield f"{len(np.unique(dataset.images.pass_id.codes)):,}", "passes"
    if evaluation is not None:
        yield _percent(evaluation.recall), f"recall of {evaluation.recoverable_objects:,} recoverable objects"
        yield _percent(evaluation.precision), "precision"
        if evaluation.true_positives:
            flat = "" if evaluation.matches.objects.has_height else "horizontal "
            yield f"{np.nanmedian(error_m(result, evaluation)):.2f} m", f"median {flat}position error"
    elif is_there.any():
        yield f"{np.median(labels.votes[is_there]):,.0f}", "votes per label, median"
        yield f"{np.median(spread_m(result)[is_there]):.2f} m", "sigma of a position, median"
    if len(result.votes):
        yield f"{result.votes.residual_px.mean():.2f} px", "mean reprojection error"
    seconds = [stage.get("seconds") for stage in result.run.get("stages", []) if isinstance(stage, dict)]
    if seconds:
        yield _seconds(sum(float(s) for s in seconds if s is not None)), "for the map, on the machine that made it"


def _seconds(seconds: float) -> str:
    if seconds >= 600.0:
        return f"{seconds / 60.0:,.0f} min"
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.2g} s"


def _percent(share: float) -> str:
    return "–" if np.isnan(share) else f"{100.0 * share:.1f} %"  # noqa: RUF001


def _cards(
    result: Map, rows: Ints, evaluation: Evaluation | None, crops: dict[int, list[tuple[str, str]]]
) -> Iterable[Card]:
    labels = result.labels
    error = None if evaluation is None else error_m(result, evaluation)
    spread = spread_m(result)
    for row in rows.tolist():
        expected = "" if labels.expected is None else f" of {labels.expected[row]}"
        passes = f"{labels.passes[row]} {'pass' if labels.passes[row] == 1 else 'passes'}"
        existence = "" if labels.existence is None else f", existence {probability(labels.existence[row])}"
        lines = [f"{labels.votes[row]}{expected} images, {passes}", f"sigma {spread[row]:.2f}\u00a0m{existence}"]
        if labels.state is not None:
            lines.append(f"state: {labels.state.names[labels.state.codes[row]]}")
        if evaluation is not None and error is not None:
            outcome = evaluation.matches.label_outcome
            off = f", {error[row]:.2f}\u00a0m off" if np.isfinite(error[row]) else ""
            lines.append(f"against the truth: {outcome.names[outcome.codes[row]]}{off}")
        name = labels.class_name.names[labels.class_name.codes[row]]
        yield Card(row, f"Label {labels.label_id[row]}: {name}", tuple(lines), tuple(crops.get(row, ())))


def _crops(evidence: Evidence, pictures: Path | None, first_rows: Iterable[int]) -> dict[int, list[tuple[str, str]]]:
    """Return crops (JPEG in base64, caption) of labels by row: the listed first, then more while there is room."""
    if pictures is None or not pictures.is_dir():
        return {}
    labels = evidence.result.labels
    order = list(dict.fromkeys([*map(int, first_rows), *range(len(labels))]))
    crops: dict[int, list[tuple[str, str]]] = {}
    for row in order[: _MOST_CROPS // _CROPS_PER_LABEL]:
        voters = evidence.voters(int(labels.label_id[row]))
        crops[row] = [
            (
                thumbnail(
                    voter_crop(evidence, pictures, voters, i, _CROP_PX),
                    voters.box_px[i],
                    voters.size_px[i],
                    voters.projected_px[i],
                ),
                f"{evidence.image_name(int(voters.image_row[i]))}: {voters.residual_px[i]:.1f} px, "
                f"{voters.residual_sigmas[i]:.1f} sigmas",
            )
            for i in map(int, chosen_voters(voters, _CROPS_PER_LABEL))
        ]
    return crops


def _notes(
    result: Map,
    dataset: Dataset | None,
    evidence: Evidence | None,
    evaluation: Evaluation | None,
    passes: PassesResult | None,
    crops: dict[int, list[tuple[str, str]]],
) -> Iterable[str]:
    yield from (str(note) for note in result.run.get("notes", []) if isinstance(note, str))
    if evaluation is not None:
        yield from (f"{note[0].upper()}{note[1:]}." for note in evaluation.notes)
    else:
        yield "Nothing was compared with a truth: give one with --truth."
    if passes is None and dataset is not None:
        yield "What more passes bring was not measured: valuemap experiment passes does, and --passes shows it."
    if dataset is None:
        yield "The dataset of the map was not given: streets, rays, crops and the paper's tables are missing."
    elif not crops:
        yield "The dataset has no pictures: there are no crops."
    elif len(crops) < len(result.labels):
        yield f"Crops are of {len(crops):,} labels, the worst and most doubtful first."
    if evidence is not None:
        without = len(evidence.dataset.detections) - len(result.votes)
        yield f"{without:,} of {len(evidence.dataset.detections):,} detections vote for no label."
    yield "In the paper's tables San Francisco and New York City are other data, which nobody else has."
    yield "White boxes in crops are detections, orange crosses are where the label projects."
