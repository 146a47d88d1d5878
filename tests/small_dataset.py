"""A small dataset and a small map, whole and valid, for tests that then spoil or measure them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from valuemap.dataset import Dataset, Frame
from valuemap.map_folder import Map
from valuemap.tables import Cameras, Categories, Detections, Images, Labels, Truth, TruthDetections, Votes

ANCHOR = (51.5, -0.14, 35.0)
# Camera axes (x right, y down, z forward) of a level camera that looks along world y, with z up.
LOOKING_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def small_dataset(frame: Frame | None = None) -> Dataset:
    """Return two cameras, four images of two passes along x, five detections and two true objects."""
    center = np.array([[0.0, 0.0, 1.5], [4.0, 0.0, 1.5], [8.0, 0.5, 1.6], [12.0, 0.0, 1.4]])
    quaternion = Rotation.from_matrix(LOOKING_ALONG_Y).as_quat(scalar_first=True)
    return Dataset(
        name="small",
        frame=frame or Frame(),
        cameras=Cameras(
            camera_id=np.array([1, 2]),
            model=Categories.from_texts(["PINHOLE", "OPENCV"]),
            width_px=np.array([640, 800]),
            height_px=np.array([480, 600]),
            params=[
                np.array([500.0, 500.0, 320.0, 240.0]),
                np.array([600.0, 600.0, 400.0, 300.0, -0.1, 0.01, 0.001, -0.001]),
            ],
        ),
        images=Images(
            image_id=np.array([10, 20, 30, 40]),
            name=pa.array(["a/1.jpg", "a/2.jpg", "b/1.jpg", "b/2.jpg"]),
            camera_id=np.array([1, 1, 2, 2]),
            cam_from_world_quat=np.tile(quaternion, (4, 1)),
            cam_from_world_m=-center @ LOOKING_ALONG_Y.T,
            pass_id=Categories.from_texts(["a", "a", "b", "b"]),
            timestamp_s=np.array([0.0, 0.5, 60.0, np.nan]),
        ),
        detections=Detections(
            detection_id=np.array([100, 101, 102, 103, 104]),
            image_id=np.array([10, 20, 30, 30, 40]),
            class_name=Categories.from_texts(["light", "light", "light", "sign", "sign"]),
            center_px=np.array([[400.0, 200.0], [320.0, 200.0], [350.0, 250.0], [500.0, 280.0], [400.0, 280.0]]),
            size_px=np.array([[10.0, 20.0]] * 5),
            score=np.array([0.9, 0.8, 0.7, 0.6, 0.5]),
        ),
        truth=Truth(
            object_id=np.array([7, 8]),
            class_name=Categories.from_texts(["light", "sign"]),
            position_in_world_m=np.array([[4.0, 25.0, 5.0], [12.0, 20.0, 2.0]]),
        ),
        truth_detections=TruthDetections(
            detection_id=np.array([100, 101, 102, 103, 104]), object_id=np.array([7, 7, 7, 8, 8])
        ),
    )


def map_of(
    positions: Sequence[Sequence[float]] | np.ndarray[Any, Any],
    classes: Sequence[str] | None = None,
    *,
    frame: Frame | None = None,
    lon_lat_height: np.ndarray[Any, Any] | None = None,
    residual_px: Sequence[float] = (),
    run: dict[str, Any] | None = None,
    existence: Sequence[float] | None = None,
) -> Map:
    """Return a map with labels at positions (N, 3), each with a covariance of diag(0.04, 0.01, 0.09) m²."""
    position = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    count = len(position)
    ids = np.arange(count)
    labels = Labels(
        label_id=ids,
        class_name=Categories.from_texts(classes if classes is not None else ["light"] * count),
        position_in_world_m=position,
        covariance_m2=np.tile([0.04, 0.0, 0.0, 0.01, 0.0, 0.09], (count, 1)),
        votes=np.full(count, 5),
        passes=np.full(count, 2),
        object_width_m=np.full(count, 0.3),
        object_height_m=np.full(count, 0.9),
        reprojection_rms_px=np.full(count, 1.5),
        max_parallax_rad=np.full(count, 0.4),
        first_seen_s=np.full(count, np.nan),
        last_seen_s=np.full(count, 12.5),
        facing_azimuth_rad=np.full(count, 4.7),
        facing_concentration=np.full(count, 0.9),
        lon_lat_height=lon_lat_height,
        existence=None if existence is None else np.array(existence, np.float64),
    )
    votes = Votes(
        label_id=np.zeros(len(residual_px), np.int64),
        detection_id=np.arange(len(residual_px)),
        image_id=np.arange(len(residual_px)),
        residual_px=np.array(residual_px, dtype=np.float64),
        residual_sigmas=np.array(residual_px, dtype=np.float64) / 2.0,
    )
    run = {"settings": {"min_parallax_deg": 2.0}} if run is None else run
    return Map(frame or Frame(), labels, votes, run)


def rewrite(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change a Parquet file."""
    pq.write_table(change(pq.read_table(path)), path)


def with_column(name: str, values: Any) -> Callable[[pa.Table], pa.Table]:
    """Return a change that sets a whole column."""

    def change(table: pa.Table) -> pa.Table:
        column = values if isinstance(values, pa.Array) else pa.array(values)
        if name not in table.column_names:
            return table.append_column(name, column)
        return table.set_column(table.column_names.index(name), name, column)

    return change


def with_value(name: str, row: int, value: Any) -> Callable[[pa.Table], pa.Table]:
    """Return a change that sets one value of a column."""

    def change(table: pa.Table) -> pa.Table:
        values = table.column(name).to_pylist()
        values[row] = value
        return with_column(name, pa.array(values))(table)

    return change


def votes_of_two_labels() -> Votes:
    """Return two votes for the first label of a map and one for the second, by detections of the dataset."""
    return Votes(
        label_id=np.array([0, 0, 1]),
        detection_id=np.array([100, 101, 103]),
        image_id=np.array([10, 20, 30]),
        residual_px=np.zeros(3),
        residual_sigmas=np.zeros(3),
    )
