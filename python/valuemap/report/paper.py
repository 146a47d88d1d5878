"""The tables of Dabisias et al., "VALUE", ICRA 2018, with their figures beside those of a map.

The paper's figures are of other data: two cities that nobody else has. They say what to compare with, not who wins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valuemap.config import PartitionConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.evaluate import Evaluation
from valuemap.map_folder import Map
from valuemap.paper.partition import partition_images
from valuemap.report.errors import error_m

Cell = int | float | str | None

CITIES = ("San Francisco (paper, other data)", "New York City (paper, other data)")

# Table I, as printed.
_IMAGES_WITH = (
    (1587, 44483),
    (6231, 145608),
    (2389, 125924),
    (1346, 32487),
    (369, 7754),
    (98, 2700),
    (17, 802),
    (9, 283),
    (0, 80),
    (1, 51),
    (1, 35),
)
_PASSES = ((47, 476), (43, 304), (9, 229), (6, 121), (1, 49), (4, 27), (6, 0), (6, 0), (1, 0))


@dataclass(frozen=True)
class ReportTable:
    """A table of the report: a title, the names of its columns, rows of cells (None: not known), notes below it.

    `name` is that of its CSV file.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()


def paper_tables(result: Map, dataset: Dataset, evaluation: Evaluation | None) -> list[ReportTable]:
    """Return Tables I, II and III of the paper with a column of our own."""
    radius_m = result.setting("cluster_radius_m", PartitionConfig().cluster_radius_m)
    cluster = partition_images(dataset.images, PartitionConfig(radius_m)).astype(np.int64)
    clusters = int(cluster.max()) + 1
    tables = [
        _table_1(result, dataset, evaluation, clusters, radius_m),
        _table_2(dataset, cluster),
    ]
    if evaluation is not None:
        tables.append(_table_3(dataset.name, result, evaluation))
    return tables


def _table_1(
    result: Map, dataset: Dataset, evaluation: Evaluation | None, clusters: int, radius_m: float
) -> ReportTable:
    images, detections = len(dataset.images), len(dataset.detections)
    row = rows_of(dataset.detections.image_id, dataset.images.image_id)
    found = np.bincount(np.minimum(np.bincount(row, minlength=images), 10), minlength=11)
    objects = None if evaluation is None else evaluation.objects
    detectable = None if evaluation is None else evaluation.recoverable_objects
    rows: list[tuple[Cell, ...]] = [
        ("images", images, 12048, 360207),
        ("detections", detections, 17198, 547689),
        ("clusters", clusters, 172, 3941),
        ("objects (paper: traffic lights)", objects, 183, 1732),
        ("detectable objects", detectable, 167, 1906),
        ("labels in the map", int(np.sum(result.is_there)), None, None),
        ("views per cluster, mean", images / clusters, 70.05, 91.4),
        ("detections per image, mean", detections / images, 1.65, 2.84),
    ]
    rows += [
        (f"images with {i}{'+' if i == 10 else ''} detections", int(found[i]), *_IMAGES_WITH[i]) for i in range(11)
    ]
    return ReportTable(
        "table_1_data",
        "Table 1. Detections and clusters",
        ("", dataset.name, *CITIES),
        tuple(rows),
        (
            f"A cluster holds the images within {radius_m:g} m of a seed, as in the paper.",
            "The paper's own figures do not all agree: 17,198 detections in 12,048 images are 1.43 per image, not "
            "1.65, and New York City has more detectable lights than lights. They stand here as printed.",
        ),
    )


def _table_2(dataset: Dataset, cluster: np.ndarray[tuple[int], np.dtype[np.int64]]) -> ReportTable:
    pairs = np.unique(np.stack([cluster, dataset.images.pass_id.codes.astype(np.int64)]), axis=1)
    count = np.bincount(np.bincount(pairs[0]))
    most = max(len(count) - 1, len(_PASSES))
    rows = [
        (n, int(count[n]) if n < len(count) else 0, *(_PASSES[n - 1] if n <= len(_PASSES) else (0, 0)))
        for n in range(1, most + 1)
    ]
    shown = rows if most <= 30 else [row for row in rows if any(row[1:])]
    return ReportTable(
        "table_2_passes",
        "Table 2. Passes per cluster",
        ("passes", f"clusters: {dataset.name}", *CITIES),
        tuple(shown),
    )


def _table_3(name: str, result: Map, evaluation: Evaluation) -> ReportTable:
    rows: tuple[tuple[Cell, ...], ...] = (
        ("true positives", evaluation.true_positives, 156, 1560),
        ("false positives", evaluation.false_positives, 4, 84),
        ("false negatives", evaluation.false_negatives, 11, 172),
        ("duplicates", evaluation.duplicates, 14, 56),
        ("recall", _known(evaluation.recall), 156 / 167, 1560 / 1732),
        ("false positives per true positive", _share(evaluation.false_positives, evaluation), 4 / 156, 84 / 1560),
        ("duplicates per true positive", _share(evaluation.duplicates, evaluation), 14 / 156, 56 / 1560),
        ("mean reprojection error (px)", _known(evaluation.mean_reprojection_error_px), 2.94, 3.24),
        *_position_errors(result, evaluation),
    )
    return ReportTable(
        "table_3_results",
        "Table 3. Results",
        ("", name, *CITIES),
        rows,
        (
            f"Labels and objects are matched one to one within {evaluation.radius_m:g} m.",
            "The paper's results were inspected by hand; its recall and shares are computed from its counts.",
            "Where the truth holds only part of the objects, labels of the others count as false.",
            *(f"{note[0].upper()}{note[1:]}." for note in evaluation.notes),
        ),
    )


def _position_errors(result: Map, evaluation: Evaluation) -> tuple[tuple[Cell, ...], ...]:
    """Return the rows of the errors of positions: horizontal ones where the truth has no heights."""
    error = error_m(result, evaluation)
    error = error[~np.isnan(error)]
    what = "position error" if evaluation.matches.objects.has_height else "horizontal position error"
    rms, median = (math.sqrt(np.mean(error**2)), float(np.median(error))) if len(error) else (None, None)
    return (f"{what}, rms (m)", rms, None, None), (f"{what}, median (m)", median, None, None)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _share(count: int, evaluation: Evaluation) -> float | None:
    return count / evaluation.true_positives if evaluation.true_positives else None
