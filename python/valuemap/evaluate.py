"""How good a map is: labels matched one to one with known objects, then counted and measured.

A label and an object of one class may be matched within a radius. Of all one-to-one matchings the one with
the most matches counts, and of those the one with the smallest sum of distances. Then every label is

    true       matched with an object,
    duplicate  not matched, but within the radius of an object that another label took,
    false      neither,

and every object is found, missed, or not recoverable: nobody can place an object that was not detected from
two sufficiently different directions, so such objects do not count in the recall.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from valuemap.cameras import camera_centers
from valuemap.config import VoteConfig
from valuemap.csv_table import read_csv_arrow
from valuemap.dataset import Dataset, Frame, read_dataset, rows_of
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import Map, read_map
from valuemap.tables import (
    Bools,
    Categories,
    Floats,
    GeographicTruth,
    Ints,
    Labels,
    Truth,
    TruthDetections,
    TruthPoints,
    read_arrow,
    table_from_arrow,
)

LABEL_OUTCOMES = ("duplicate", "false", "true")
OBJECT_OUTCOMES = ("found", "missed", "not recoverable")

_MEASURES = (
    "true_positives",
    "duplicates",
    "false_positives",
    "false_negatives",
    "recall",
    "precision",
    "position_rmse_m",
    "position_median_m",
    "horizontal_rmse_m",
    "vertical_rmse_m",
    "mean_reprojection_error_px",
)
"""The names that `valuemap evaluate --json` prints, in this order."""

_VIEWS_AT_ONCE = 1000
"""Rows of a block of pairwise distances between the views of one object; bounds memory, changes no result."""


@dataclass(frozen=True, eq=False)
class TrueObjects:
    """What a map is compared with, in the frame of the map.

    `position_in_world_m` is (N, 3). `class_name` is None where the truth has no classes: then any class
    matches. `is_recoverable` (N) is None where nobody recorded which images detected the objects: then all
    count. Without `has_height` the vertical part of the positions means nothing and matching is horizontal.
    """

    object_id: Ints
    position_in_world_m: Floats
    class_name: Categories | None = None
    is_recoverable: Bools | None = None
    has_height: bool = True

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def counts_in_recall(self) -> Bools:
        """Which objects (N) a map should hold."""
        return np.ones(len(self), np.bool_) if self.is_recoverable is None else self.is_recoverable


@dataclass(frozen=True, eq=False)
class Matches:
    """What became of every label and every true object.

    `object_of_label` (labels) holds the row of the matched object or -1, `label_of_object` (objects) the row
    of the matched label or -1; the outcomes are texts of LABEL_OUTCOMES and OBJECT_OUTCOMES.
    """

    objects: TrueObjects
    object_of_label: Ints
    label_of_object: Ints
    label_outcome: Categories
    object_outcome: Categories

    @property
    def object_in_world_m(self) -> Floats:
        """Positions (objects, 3) of the true objects in metres in the frame of the map."""
        return self.objects.position_in_world_m


@dataclass(frozen=True)
class Evaluation:
    """Counts and errors of one map against the truth; NaN where there is nothing to measure.

    precision = true_positives / labels, so that duplicates cost; recall = recoverable objects found /
    recoverable_objects; false_negatives are the recoverable objects not found. Position errors are over the
    true positives, horizontal and vertical with respect to the up of the map's frame (root mean squares of
    lengths, so position² = horizontal² + vertical²). The reprojection error is the mean over all votes.
    """

    true_positives: int
    duplicates: int
    false_positives: int
    false_negatives: int
    recall: float
    precision: float
    position_rmse_m: float
    position_median_m: float
    horizontal_rmse_m: float
    vertical_rmse_m: float
    mean_reprojection_error_px: float
    labels: int
    objects: int
    recoverable_objects: int
    radius_m: float
    notes: tuple[str, ...]
    """What a reader of the numbers must know, e.g. that every object counts as recoverable."""
    matches: Matches = field(repr=False, compare=False)

    def to_json(self) -> dict[str, int | float | None]:
        """Return the measures by name, None where there is nothing to measure."""
        values = {name: getattr(self, name) for name in _MEASURES}
        return {name: None if math.isnan(value) else value for name, value in values.items()}


def evaluate_map(
    result: Map | str | Path,
    truth: Dataset | Truth | str | Path,
    *,
    radius_m: float = 2.0,
    min_parallax_rad: float | None = None,
) -> Evaluation:
    """Compare a map with known objects.

    Parameters
    ----------
    result
        A map, or the folder of one.
    truth
        A dataset with truth or its folder, a table of objects in the frame of the map, or a file of objects
        (see `read_truth`).
    radius_m
        A label and an object farther apart than this are never matched.
    min_parallax_rad
        An object is recoverable if two images that detected it see it from directions that differ by at
        least this angle. Default: the `min_parallax_deg` that the map was made with.

    Raises
    ------
    InputError
        There is no truth, it cannot be read, or it is in another frame than the map.
    SettingError
        The radius or the angle is impossible.
    """
    if isinstance(result, str | Path):
        result = read_map(result)
    objects = _true_objects(truth, result, min_parallax_rad)
    return _measure(result, match_labels(result.labels, objects, result.frame, radius_m=radius_m), radius_m)


def read_truth(path: Path, result: Map) -> Dataset | TrueObjects:
    """Read the truth for a map: a dataset folder, or a file of objects.

    A file has one object a row. It is .csv or .parquet with columns x, y, z in the frame of the map or, for
    geo-referenced maps, lon, lat (WGS84 degrees) and perhaps height (ellipsoidal, m); or .geojson, .gpkg or
    .fgb with points. Columns `class` and `object_id` are optional. Where a file has both kinds of positions,
    the geographic ones count if they are complete, because x, y, z may belong to another anchor. Without
    heights the objects are matched horizontally.

    Raises
    ------
    InputError
        The file is missing, of an unknown kind, damaged, or cannot be brought to the frame of the map.
    """
    if path.is_dir():
        return read_dataset(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder", hint="give a dataset folder or a file of objects")
    if path.suffix.lower() not in _TRUTH_READERS:
        raise InputError(
            f"{path}: truth of an unknown kind: {path.suffix or 'no suffix'}",
            hint=f"give a dataset folder or one of {', '.join(_TRUTH_READERS)}",
        )
    table = _TRUTH_READERS[path.suffix.lower()](path)
    columns = {*table.column_names}
    has_position, has_place = {"x", "y", "z"} <= columns, {"lon", "lat"} <= columns
    anchor = result.frame.anchor
    if has_place and anchor is not None and ("height" in columns or not has_position):
        places = table_from_arrow(GeographicTruth, table, source=str(path))
        return _objects_on_earth(places, anchor, result.labels)
    if has_place and not has_position:
        raise InputError(
            f"{path}: has longitude and latitude, but the map is not geo-referenced",
            hint="give x, y, z in the frame of the map",
        )
    points = table_from_arrow(TruthPoints, table, source=str(path))
    return _sorted_objects(points, points.position_in_world_m)


def match_labels(labels: Labels, objects: TrueObjects, frame: Frame, *, radius_m: float = 2.0) -> Matches:
    """Match labels with true objects one to one: most matches first, then the smallest sum of distances.

    Raises
    ------
    SettingError
        The radius is not a length.
    """
    if not (math.isfinite(radius_m) and radius_m > 0.0):
        raise SettingError(f"radius: expected above 0 m, found {radius_m}", hint="the default is 2 m")
    label, true_object, distance_m = _pairs_within(labels, objects, frame, radius_m)
    chosen = _best_assignment(label, true_object, distance_m, radius_m)
    object_of_label = np.full(len(labels), -1, dtype=np.int64)
    label_of_object = np.full(len(objects), -1, dtype=np.int64)
    object_of_label[label[chosen]] = true_object[chosen]
    label_of_object[true_object[chosen]] = label[chosen]

    is_near = np.zeros(len(labels), dtype=np.bool_)
    is_near[label] = True  # Were its neighbour free, it would be matched with it.
    label_outcome = np.select([object_of_label >= 0, is_near], [2, 0], default=1)
    object_outcome = np.select([label_of_object >= 0, objects.counts_in_recall], [0, 1], default=2)
    return Matches(
        objects=objects,
        object_of_label=object_of_label,
        label_of_object=label_of_object,
        label_outcome=Categories(label_outcome.astype(np.int32), LABEL_OUTCOMES),
        object_outcome=Categories(object_outcome.astype(np.int32), OBJECT_OUTCOMES),
    )


def recoverable_objects(dataset: Dataset, min_parallax_rad: float) -> Bools | None:
    """Return which true objects (N) two images detected from directions at least `min_parallax_rad` apart.

    A direction is that from a camera centre to the true object. None where the dataset does not say which
    detection shows which object.
    """
    if dataset.truth is None or dataset.truth_detections is None:
        return None
    object_row, direction = _views(dataset.truth, dataset.truth_detections, dataset)
    return _are_spread(object_row, direction, len(dataset.truth), 2.0 * math.sin(min_parallax_rad / 2.0))


def _measure(result: Map, matches: Matches, radius_m: float) -> Evaluation:
    objects = matches.objects
    found = matches.object_of_label >= 0
    offset = result.labels.position_in_world_m[found] - objects.position_in_world_m[matches.object_of_label[found]]
    vertical = offset @ np.array(result.frame.up)
    horizontal = np.linalg.norm(offset - vertical[:, None] * result.frame.up, axis=1)
    if not objects.has_height:
        vertical = np.full(len(vertical), np.nan)
    distance = np.hypot(horizontal, vertical)

    labels, true_positives = len(found), int(found.sum())
    recoverable = int(objects.counts_in_recall.sum())
    missed = int(np.sum(objects.counts_in_recall & (matches.label_of_object < 0)))
    outcomes = np.bincount(matches.label_outcome.codes, minlength=len(LABEL_OUTCOMES))
    return Evaluation(
        true_positives=true_positives,
        duplicates=int(outcomes[LABEL_OUTCOMES.index("duplicate")]),
        false_positives=int(outcomes[LABEL_OUTCOMES.index("false")]),
        false_negatives=missed,
        recall=_ratio(recoverable - missed, recoverable),
        precision=_ratio(true_positives, labels),
        position_rmse_m=_root_mean_square(distance),
        position_median_m=float(np.median(distance)) if true_positives else math.nan,
        horizontal_rmse_m=_root_mean_square(horizontal),
        vertical_rmse_m=_root_mean_square(vertical),
        mean_reprojection_error_px=float(result.votes.residual_px.mean()) if len(result.votes) else math.nan,
        labels=labels,
        objects=len(objects),
        recoverable_objects=recoverable,
        radius_m=radius_m,
        notes=_notes(objects),
        matches=matches,
    )


def _notes(objects: TrueObjects) -> tuple[str, ...]:
    notes = {
        "every true object counts as recoverable: the truth does not say which detections show it": (
            objects.is_recoverable is None
        ),
        "a label may match an object of any class: the truth has no classes": objects.class_name is None,
        "labels are matched horizontally, without vertical and 3D errors: the truth has no heights": (
            not objects.has_height
        ),
    }
    return tuple(note for note, applies in notes.items() if applies)


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _root_mean_square(values: Floats) -> float:
    return math.sqrt(np.mean(values**2)) if len(values) else math.nan


def _min_parallax_of(result: Map) -> float:
    settings = result.run.get("settings")
    degrees = settings.get("min_parallax_deg") if isinstance(settings, dict) else None
    return math.radians(degrees if isinstance(degrees, int | float) else VoteConfig().min_parallax_deg)


# From truth to objects in the frame of the map.


def _true_objects(truth: Dataset | Truth | str | Path, result: Map, min_parallax_rad: float | None) -> TrueObjects:
    source = read_truth(Path(truth), result) if isinstance(truth, str | Path) else truth
    if isinstance(source, Dataset):
        angle = _min_parallax_of(result) if min_parallax_rad is None else min_parallax_rad
        return _objects_of_dataset(source, result.frame, angle)
    if isinstance(source, Truth):
        return TrueObjects(source.object_id, source.position_in_world_m, source.class_name)
    return source


def _objects_of_dataset(dataset: Dataset, frame: Frame, min_parallax_rad: float) -> TrueObjects:
    truth = dataset.truth
    if truth is None:
        raise InputError(
            f"{dataset.name}: the dataset has no truth",
            hint="add truth.parquet, or give a file of true objects",
        )
    if not 0.0 <= min_parallax_rad <= math.pi:
        raise SettingError(
            f"min_parallax: expected 0 to 180 degrees, found {math.degrees(min_parallax_rad):g}",
            hint="the default is that of the map",
        )
    position = truth.position_in_world_m
    if frame.anchor is not None and dataset.frame.anchor is not None:
        if frame.anchor != dataset.frame.anchor:
            position = enu_from_lon_lat_height(lon_lat_height_from_enu(position, dataset.frame.anchor), frame.anchor)
    elif frame.is_georeferenced or dataset.frame.is_georeferenced or not np.allclose(frame.up, dataset.frame.up):
        raise InputError(
            f"{dataset.name}: the truth is in frame {dataset.frame.to_json()}, the map in {frame.to_json()}",
            hint="evaluate with the dataset that the map was made from, or with truth in the same frame",
        )
    return TrueObjects(
        truth.object_id,
        position,
        truth.class_name,
        is_recoverable=recoverable_objects(dataset, min_parallax_rad),
    )


def _objects_on_earth(truth: GeographicTruth, anchor: tuple[float, float, float], labels: Labels) -> TrueObjects:
    """Bring WGS84 places to the ENU frame of a map, at the height of its labels where they have none.

    A wrong height shifts a place horizontally by that error times its distance from the anchor over the
    radius of the Earth: with the height of the labels, centimetres in a city.
    """
    height_m = truth.height_m
    if height_m is None:
        places = labels.lon_lat_height
        height_m = np.full(len(truth), anchor[2] if places is None or len(places) == 0 else np.median(places[:, 2]))
    position = enu_from_lon_lat_height(np.column_stack([truth.lon_lat, height_m]), anchor)
    return _sorted_objects(truth, position, has_height=truth.height_m is not None)


def _sorted_objects(
    truth: TruthPoints | GeographicTruth, position_in_world_m: Floats, *, has_height: bool = True
) -> TrueObjects:
    """Put objects in an order of their own, because that of the rows must not change any figure."""
    class_code = np.zeros(len(truth), np.int32) if truth.class_name is None else truth.class_name.codes
    object_id = np.arange(len(truth)) if truth.object_id is None else truth.object_id
    order = np.lexsort((class_code, *position_in_world_m.T))
    return TrueObjects(
        object_id=object_id[order],
        position_in_world_m=position_in_world_m[order],
        class_name=None if truth.class_name is None else truth.class_name.take(order),
        has_height=has_height,
    )


def _read_csv(path: Path) -> pa.Table:
    numbers = dict.fromkeys(("x", "y", "z", "lon", "lat", "height"), pa.float64())
    types = {**numbers, "class": pa.string(), "object_id": pa.int64()}
    hint = "separate columns by commas, their names in the first line"
    return read_csv_arrow(path, types, has_missing=True, hint=hint)


def _read_points(path: Path) -> pa.Table:
    import geopandas  # Slow to import, and only files of points need it.
    import pyogrio

    try:
        points = geopandas.read_file(path)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read: {reason}", hint="is it a file of points that QGIS opens?") from error
    if not isinstance(points, geopandas.GeoDataFrame) or points.crs is None:
        raise InputError(f"{path}: has no geometries in a coordinate system", hint="save it as points, e.g. in WGS 84")
    kinds = points.geom_type.to_numpy()
    wrong = np.flatnonzero(kinds != "Point")
    if len(wrong):
        raise InputError(
            f"{path} row {wrong[0]}: expected a point, found {kinds[wrong[0]]} ({len(wrong)} rows)",
            hint="give every object as one point",
        )
    coordinates = points.to_crs("EPSG:4326").get_coordinates(include_z=True)
    columns = {"lon": coordinates["x"], "lat": coordinates["y"]}
    if not coordinates["z"].isna().all():
        columns["height"] = coordinates["z"]
    columns |= {name: points[name] for name in ("class", "object_id") if name in points}
    return pa.table({name: pa.array(column, from_pandas=True) for name, column in columns.items()})


_TRUTH_READERS: dict[str, Callable[[Path], pa.Table]] = {
    ".csv": _read_csv,
    ".parquet": read_arrow,
    ".geojson": _read_points,
    ".gpkg": _read_points,
    ".fgb": _read_points,
}


# Matching.


def _pairs_within(labels: Labels, objects: TrueObjects, frame: Frame, radius_m: float) -> tuple[Ints, Ints, Floats]:
    """Return label row, object row and distance (m) of every pair of one class within the radius."""
    from scipy.spatial import KDTree  # Slow to import, and only evaluation needs it.

    label_points, object_points = labels.position_in_world_m, objects.position_in_world_m
    if not objects.has_height:
        along_ground = np.eye(3) - np.outer(frame.up, frame.up)
        label_points, object_points = label_points @ along_ground, object_points @ along_ground
    if len(labels) == 0 or len(objects) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    pairs = KDTree(label_points).sparse_distance_matrix(KDTree(object_points), radius_m, output_type="ndarray")
    label, true_object, distance_m = pairs["i"], pairs["j"], pairs["v"]
    if objects.class_name is not None:
        code_in_truth = np.array([objects.class_name.code_of(name) for name in labels.class_name.names], np.int64)
        same = code_in_truth[labels.class_name.codes[label]] == objects.class_name.codes[true_object]
        label, true_object, distance_m = label[same], true_object[same], distance_m[same]
    order = np.lexsort((true_object, label))  # The tree promises no order.
    return label[order], true_object[order], distance_m[order]


def _best_assignment(label: Ints, true_object: Ints, distance_m: Floats, radius_m: float) -> Ints:
    """Return the pairs (rows) that make the most matches and, of such choices, the smallest sum of distances.

    Every label may also stay alone at a cost above any sum of distances, so that the cheapest assignment of
    all labels has as many matches as possible. One sparse problem for all: its size follows the pairs.
    """
    from scipy.sparse import csr_array  # Slow to import, and only evaluation needs it.
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    # A pair whose label and object have no other is matched in any case.
    is_alone = (np.bincount(label)[label] == 1) & (np.bincount(true_object)[true_object] == 1)
    alone, rest = np.flatnonzero(is_alone), np.flatnonzero(~is_alone)
    if len(rest) == 0:
        return alone
    labels, label = np.unique(label[rest], return_inverse=True)
    objects, true_object = np.unique(true_object[rest], return_inverse=True)
    # The 1 in all costs keeps zeros, which would be no edges, out of the sparse matrix.
    alone_cost = 1.0 + radius_m * (len(objects) + 1)
    row = np.concatenate([label, np.arange(len(labels))])
    column = np.concatenate([true_object, len(objects) + np.arange(len(labels))])
    cost = np.concatenate([1.0 + distance_m[rest], np.full(len(labels), alone_cost)])
    graph = csr_array((cost, (row, column)), shape=(len(labels), len(objects) + len(labels)))
    matched_object = np.empty(len(labels), np.int64)
    rows, columns = min_weight_full_bipartite_matching(graph)
    matched_object[rows] = columns
    return np.concatenate([alone, rest[matched_object[label] == true_object]])


# Which objects are recoverable.


def _views(truth: Truth, pairs: TruthDetections, dataset: Dataset) -> tuple[Ints, Floats]:
    """Return object row (M), ascending, and unit direction (M, 3) of every image that detected an object."""
    detection_row = rows_of(pairs.detection_id, dataset.detections.detection_id)
    image_row = rows_of(dataset.detections.image_id[detection_row], dataset.images.image_id)
    view = np.unique(np.column_stack([rows_of(pairs.object_id, truth.object_id), image_row]), axis=0)
    object_row, image_row = view.T
    direction = truth.position_in_world_m[object_row] - camera_centers(dataset.images)[image_row]
    return object_row, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def _are_spread(group: Ints, direction: Floats, groups: int, min_chord: float) -> Bools:
    """Return for each group of unit vectors (M, 3) whether two are `min_chord` apart or more; `group` ascends.

    Exact. With c the longest chord from the first vector of a group, some chord has length c and none is
    longer than 2c, which decides almost all groups at once; all pairs are measured in the others only.
    """
    start = np.searchsorted(group, np.arange(groups + 1))
    count = np.diff(start)
    seen = np.flatnonzero(count)
    from_first = np.linalg.norm(direction - direction[start[group]], axis=1)
    longest = np.zeros(groups)
    longest[seen] = np.maximum.reduceat(from_first, start[seen]) if len(seen) else 0.0
    is_spread: Bools = (count >= 2) & (longest >= min_chord)
    for row in np.flatnonzero((count >= 3) & ~is_spread & (2.0 * longest >= min_chord)):
        is_spread[row] = _longest_chord_reaches(direction[start[row] : start[row + 1]], min_chord)
    return is_spread


def _longest_chord_reaches(direction: Floats, min_chord: float) -> bool:
    from scipy.spatial.distance import cdist  # Slow to import, and only evaluation needs it.

    from_mean = np.linalg.norm(direction - direction.mean(axis=0), axis=1)
    # By the triangle inequality the others are too near to all.
    far = direction[from_mean + from_mean.max() >= min_chord]
    blocks = (far[i : i + _VIEWS_AT_ONCE] for i in range(0, len(far), _VIEWS_AT_ONCE))
    return any(bool(np.any(cdist(block, far) >= min_chord)) for block in blocks)
