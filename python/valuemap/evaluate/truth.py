"""What a map is compared with: objects of a dataset, a table or a file, in the frame of the map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import VoteConfig
from valuemap.dataset import Dataset, Frame, read_dataset
from valuemap.errors import InputError, SettingError
from valuemap.evaluate.objects_file import check_objects_file, read_objects_file
from valuemap.evaluate.recoverable import recoverable_objects
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import MARKER, Map
from valuemap.tables import Categories, GeographicTruth, Labels, Truth, TruthPoints


@dataclass(frozen=True, eq=False)
class TrueObjects:
    """What a map is compared with, in the frame of the map.

    `position_in_world_m` is (N, 3). `class_name` is None where the truth has no classes: then any class
    matches. `is_recoverable` (N) is None where nobody recorded which images detected the objects: then all
    count. Without `has_height` the vertical part of the positions means nothing and matching is horizontal; where
    some objects have a height, `is_height_known` (N) says which. `sigma_m` (N) is the standard deviation of the
    positions on each axis, NaN where it is not known.
    """

    object_id: Ints
    position_in_world_m: Floats
    class_name: Categories | None = None
    is_recoverable: Bools | None = None
    has_height: bool = True
    sigma_m: Floats | None = None
    is_height_known: Bools | None = None
    notes: tuple[str, ...] = ()
    """What a reader of the figures must know of where they come from."""

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def counts_in_recall(self) -> Bools:
        """Which objects (N) a map should hold."""
        return np.ones(len(self), np.bool_) if self.is_recoverable is None else self.is_recoverable

    @property
    def knows_height(self) -> Bools:
        """Which objects (N) have a height."""
        return np.full(len(self), self.has_height) if self.is_height_known is None else self.is_height_known


def true_objects(truth: Dataset | Truth | str | Path, result: Map, min_parallax_rad: float | None) -> TrueObjects:
    """Return the objects of a dataset, a table, a folder or a file in the frame of a map; raises as `evaluate_map`."""
    source = read_truth(Path(truth), result) if isinstance(truth, str | Path) else truth
    if isinstance(source, Dataset):
        if min_parallax_rad is None:
            min_parallax_rad = math.radians(result.setting("min_parallax_deg", VoteConfig().min_parallax_deg))
        return _objects_of_dataset(source, result.frame, min_parallax_rad)
    if isinstance(source, Truth):
        return TrueObjects(source.object_id, source.position_in_world_m, source.class_name)
    return source


def read_truth(path: Path, result: Map) -> Dataset | TrueObjects:
    """Read the truth for a map: a dataset folder, or a file of objects.

    A file has one object a row. It is .csv, .tsv or .parquet with columns x, y, z in the frame of the map or, for
    geo-referenced maps, lon, lat (WGS84 degrees) and perhaps height (ellipsoidal, m); or a file of points that GDAL
    reads, such as .geojson, .gpkg or .shp. Columns `class`, `object_id` and `sigma` are optional. Where a file has both
    kinds of positions, the geographic ones count if they are complete, because x, y, z may belong to another anchor.
    Unless all have heights the objects are matched horizontally.

    Raises
    ------
    InputError
        The file is missing, of an unknown kind, damaged, or cannot be brought to the frame of the map.
    """
    if path.is_dir():
        if (path / MARKER).is_file():
            raise InputError(
                f"{path}: is a map, expected known objects",
                hint=f"valuemap export {path} labels.csv, then --truth labels.csv, compares with its labels",
            )
        return read_dataset(path)
    check_objects_file(path, "truth", "a dataset folder or ")
    return read_objects(path, result)


def read_objects(path: Path, result: Map) -> TrueObjects:
    """Read a file of objects, as `read_truth` describes them, that `check_objects_file` lets pass.

    Raises
    ------
    InputError
        The file is damaged, or cannot be brought to the frame of the map.
    """
    found = read_objects_file(path, result.frame)
    if isinstance(found.objects, GeographicTruth):
        assert result.frame.anchor is not None
        return _objects_on_earth(found.objects, result.frame.anchor, result.labels, found.notes)
    return _sorted_objects(found.objects, found.objects.position_in_world_m, found.notes)


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
    position = positions_in_frame(truth.position_in_world_m, dataset, frame, what="the truth is")
    return TrueObjects(
        truth.object_id,
        position,
        truth.class_name,
        is_recoverable=recoverable_objects(dataset, min_parallax_rad),
    )


def positions_in_frame(position_in_world_m: Floats, dataset: Dataset, frame: Frame, *, what: str) -> Floats:
    """Return positions (N, 3) of a dataset in the frame of a map; `what` begins the message where that cannot be.

    Raises
    ------
    InputError
        The frames have nothing to do with each other.
    """
    if frame.anchor is not None and dataset.frame.anchor is not None:
        if frame.anchor == dataset.frame.anchor:
            return position_in_world_m
        return enu_from_lon_lat_height(lon_lat_height_from_enu(position_in_world_m, dataset.frame.anchor), frame.anchor)
    if frame.is_georeferenced or dataset.frame.is_georeferenced or not np.allclose(frame.up, dataset.frame.up):
        raise InputError(
            f"{dataset.name}: {what} in a frame {dataset.frame}, the map in one {frame}",
            hint="evaluate with the dataset that the map was made from, or with one in the same frame",
        )
    return position_in_world_m


def _objects_on_earth(
    truth: GeographicTruth, anchor: tuple[float, float, float], labels: Labels, notes: tuple[str, ...]
) -> TrueObjects:
    """Bring WGS84 places to the ENU frame of a map, at the height of its labels where they have none.

    A wrong height shifts a place horizontally by that error times its distance from the anchor over the
    radius of the Earth: with the height of the labels, centimetres in a city.
    """
    height_m = np.full(len(truth), np.nan) if truth.height_m is None else truth.height_m
    is_known = np.isfinite(height_m)
    if not is_known.all():
        places = labels.lon_lat_height
        usual_m = anchor[2] if places is None or len(places) == 0 else float(np.median(places[:, 2]))
        height_m = np.where(is_known, height_m, usual_m)
    position = enu_from_lon_lat_height(np.column_stack([truth.lon_lat, height_m]), anchor)
    return _sorted_objects(truth, position, notes, is_known)


def _sorted_objects(
    truth: TruthPoints | GeographicTruth,
    position_in_world_m: Floats,
    notes: tuple[str, ...],
    is_height_known: Bools | None = None,
) -> TrueObjects:
    """Put objects in an order of their own, because that of the rows must not change any figure."""
    is_mixed = is_height_known is not None and is_height_known.any() and not is_height_known.all()
    class_code = np.zeros(len(truth), np.int32) if truth.class_name is None else truth.class_name.codes
    object_id = np.arange(len(truth)) if truth.object_id is None else truth.object_id
    order = np.lexsort((class_code, *position_in_world_m.T))
    return TrueObjects(
        object_id=object_id[order],
        position_in_world_m=position_in_world_m[order],
        class_name=None if truth.class_name is None else truth.class_name.take(order),
        has_height=is_height_known is None or bool(is_height_known.all()),
        sigma_m=None if truth.sigma_m is None else truth.sigma_m[order],
        is_height_known=is_height_known[order] if is_height_known is not None and is_mixed else None,
        notes=notes,
    )
