"""The tables of a dataset: its cameras, images and detections, and the rows that an import left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import pyarrow as pa

from valuemap.arrays import Floats, Ints
from valuemap.tables.categories import Categories
from valuemap.tables.column import column
from valuemap.tables.table import Table


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(Table):
    """Intrinsics. `model` is a COLMAP model name, `params` in COLMAP's order (pixels, centre of pixel 0 at 0.5).

    `readout_s` is how much later the last row of a picture is exposed than the first one, negative where the last row
    comes first; NaN where all rows are exposed at once. Poses and timestamps are those of the middle row.
    """

    KEY: ClassVar[str | None] = "camera_id"

    camera_id: Ints = column("int", ("camera_id",))
    model: Categories = column("category", ("model",))
    width_px: Ints = column("int", ("width",))
    height_px: Ints = column("int", ("height",))
    params: list[Floats] = column("floats", ("params",))
    readout_s: Floats | None = column("float", ("readout_s",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class Images(Table):
    """Exposures: camera, pose, pass and time.

    `cam_from_world_quat` (N, 4) is a unit quaternion w, x, y, z and `cam_from_world_m` (N, 3) a translation:
    point_in_cam = R point_in_world + t, camera axes x right, y down, z forward. Timestamps are seconds. Images with the
    same `rig_id` were taken at one time by the cameras of one car.
    """

    KEY: ClassVar[str | None] = "image_id"

    image_id: Ints = column("int", ("image_id",))
    name: pa.Array = column("text", ("name",))
    camera_id: Ints = column("int", ("camera_id",))
    cam_from_world_quat: Floats = column("float", ("qw", "qx", "qy", "qz"))
    cam_from_world_m: Floats = column("float", ("tx", "ty", "tz"))
    pass_id: Categories = column("category", ("pass_id",))
    rig_id: Ints | None = column("int", ("rig_id",), optional=True)
    timestamp_s: Floats | None = column("float", ("timestamp",), optional=True, nullable=True)
    position_sigma_m: Floats | None = column("float", ("position_sigma_m",), optional=True, nullable=True)
    rotation_sigma_rad: Floats | None = column("float", ("rotation_sigma_rad",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class Detections(Table):
    """2D boxes: centre and size (N, 2) in pixels, class and score; optionally a measured range in metres.

    A size of 0 was not measured (bearings, key points). `vertical_sigma_px` is the standard deviation of the centre's y
    where it is not that of its x (NaN: it is); where no elevation was measured y is the horizon and it is large.
    There are none before `valuemap detect` has looked for them.
    """

    KEY: ClassVar[str | None] = "detection_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    detection_id: Ints = column("int", ("detection_id",))
    image_id: Ints = column("int", ("image_id",))
    class_name: Categories = column("category", ("class",))
    center_px: Floats = column("float", ("x", "y"))
    size_px: Floats = column("float", ("width", "height"))
    score: Floats = column("float", ("score",))
    range_m: Floats | None = column("float", ("range_m",), optional=True, nullable=True)
    range_sigma_m: Floats | None = column("float", ("range_sigma_m",), optional=True, nullable=True)
    vertical_sigma_px: Floats | None = column("float", ("vertical_sigma_px",), optional=True, nullable=True)

    @classmethod
    def none(cls) -> Self:
        """Return no detections: they are still to be made, or elsewhere."""
        numbers, pairs = np.empty(0, np.int64), np.empty((0, 2))
        return cls(numbers, numbers, Categories(np.empty(0, np.int32), ()), pairs, pairs, np.empty(0))


@dataclass(frozen=True, eq=False, repr=False)
class RejectedRows(Table):
    """Rows that an import left out, in their order: which table they were for, where they stood, and why.

    `center_px`, `size_px` (N, 2) and `score` (N) are what was found, NaN where it was no number or does not apply.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True

    table: Categories = column("category", ("table",))
    place: pa.Array = column("text", ("place",))
    reason: Categories = column("category", ("reason",))
    image_name: pa.Array = column("text", ("image",))
    class_name: Categories = column("category", ("class",))
    center_px: Floats = column("float", ("x", "y"), nullable=True)
    size_px: Floats = column("float", ("width", "height"), nullable=True)
    score: Floats = column("float", ("score",), nullable=True)
