"""The tables of known objects, for evaluation only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from valuemap.arrays import Floats, Ints
from valuemap.tables.categories import Categories
from valuemap.tables.column import column
from valuemap.tables.table import Table


@dataclass(frozen=True, eq=False, repr=False)
class Truth(Table):
    """Known objects, for evaluation only; positions (N, 3) in metres in the frame of the dataset."""

    KEY: ClassVar[str | None] = "object_id"

    object_id: Ints = column("int", ("object_id",))
    class_name: Categories = column("category", ("class",))
    position_in_world_m: Floats = column("float", ("x", "y", "z"))


@dataclass(frozen=True, eq=False, repr=False)
class TruthPoints(Table):
    """Known objects in a file of the user's own: positions (N, 3) in the frame of the map, the rest if known."""

    position_in_world_m: Floats = column("float", ("x", "y", "z"))
    class_name: Categories | None = column("category", ("class",), optional=True)
    object_id: Ints | None = column("int", ("object_id",), optional=True)
    sigma_m: Floats | None = column("float", ("sigma",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class GeographicTruth(Table):
    """Known objects in a file of the user's own: WGS84 longitude and latitude (N, 2) in degrees, the rest if known."""

    lon_lat: Floats = column("float", ("lon", "lat"))
    height_m: Floats | None = column("float", ("height",), optional=True, nullable=True)
    class_name: Categories | None = column("category", ("class",), optional=True)
    object_id: Ints | None = column("int", ("object_id",), optional=True)
    sigma_m: Floats | None = column("float", ("sigma",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class TruthDetections(Table):
    """Which object a detection really shows; detections of nothing are not listed."""

    KEY: ClassVar[str | None] = "detection_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    detection_id: Ints = column("int", ("detection_id",))
    object_id: Ints = column("int", ("object_id",))
