"""Rerun: labels with their ellipsoids, tracks, votes and true objects, to turn and look at in Rerun's viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, Frame, number_passes, rows_of
from valuemap.drives import find_drives
from valuemap.errors import SettingError
from valuemap.map_folder import Map
from valuemap.tables.covariance import covariance_matrices
from valuemap.writers.attributes import Export, refuse_crs

_COLORS = np.array(
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (240, 228, 66)],
    dtype=np.uint8,
)
"""Okabe and Ito's, which people with any kind of colour vision can tell apart."""
_TRACK, _TRUTH = (130, 140, 150), (0, 158, 115)
_SIGMAS_95 = 2.7954834829151074
"""Half axis of the ellipsoid that holds 95 % of a normal distribution in space, in sigmas: sqrt(chi2.ppf(0.95, 3))."""
_LABEL_RADIUS_M, _LINE_RADIUS_M, _VOTE_RADIUS_M = 0.12, 0.05, 0.01
_GAP_M = 25.0
"""Images of a pass farther apart than this are not joined."""


def write_rerun(export: Export, path: Path) -> None:
    """Write a recording of Rerun (.rrd), in metres in the frame of the map; the same map gives other bytes each time.

    Entities, all static: `world/labels`, `world/ellipsoids` (95 %), and with the dataset `world/tracks`, `world/votes`
    (from camera to label, coloured by pass) and `world/truth`. What users named is only ever text beside a point.

    Raises
    ------
    SettingError
        The extra rerun is not installed.
    OutputError
        Another reference system is asked for.
    """
    refuse_crs(export, "a recording of Rerun holds metres in the frame of the map")
    try:
        import rerun
    except ImportError as error:
        raise SettingError(
            "export to .rrd needs the extra named rerun", hint="pip install 'valuemap[rerun]'"
        ) from error
    result, dataset = export.result, export.dataset
    labels = result.labels
    colors = _COLORS[labels.class_name.codes % len(_COLORS)]
    recording = rerun.RecordingStream("valuemap", recording_id=f"valuemap-{result.run.get('dataset', 'map')}")
    recording.save(str(path))
    recording.log("world", getattr(rerun.ViewCoordinates, _up(result.frame)), static=True)
    recording.log(
        "world/labels",
        rerun.Points3D(
            labels.position_in_world_m,
            radii=np.full(len(labels), _LABEL_RADIUS_M),
            colors=colors,
            labels=_texts(result),
            show_labels=False,
        ),
        static=True,
    )
    half_sizes_m, quaternion_xyzw = _ellipsoids(labels.covariance_m2)
    recording.log(
        "world/ellipsoids",
        rerun.Ellipsoids3D(
            half_sizes=half_sizes_m, centers=labels.position_in_world_m, quaternions=quaternion_xyzw, colors=colors
        ),
        static=True,
    )
    if dataset is not None:
        recording.log(
            "world/tracks", rerun.LineStrips3D(_tracks(dataset), colors=[_TRACK], radii=[_LINE_RADIUS_M]), static=True
        )
        rays, number = _votes(result, dataset)
        recording.log(
            "world/votes",
            rerun.LineStrips3D(rays, colors=_COLORS[number % len(_COLORS)], radii=[_VOTE_RADIUS_M]),
            static=True,
        )
        if dataset.truth is not None:
            recording.log(
                "world/truth",
                rerun.Points3D(dataset.truth.position_in_world_m, radii=[1.5 * _LABEL_RADIUS_M], colors=[_TRUTH]),
                static=True,
            )
    recording.disconnect()  # Writes what is not yet in the file.


def _up(frame: Frame) -> str:
    """Return the name of the view coordinates whose up is nearest to that of the frame."""
    axis = int(np.argmax(np.abs(frame.up)))
    return f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if frame.up[axis] > 0 else 'DOWN'}"


def _texts(result: Map) -> list[str]:
    labels = result.labels
    existence = np.full(len(labels), np.nan) if labels.existence is None else labels.existence
    states = [""] * len(labels) if labels.state is None else [f", {state}" for state in labels.state.texts()]
    return [
        f"{label_id}: {name}, {votes} votes" + ("" if np.isnan(exists) else f", existence {exists:.3f}") + state
        for label_id, name, votes, exists, state in zip(
            labels.label_id, labels.class_name.texts(), labels.votes, existence, states, strict=True
        )
    ]


def _ellipsoids(covariance_m2: Floats) -> tuple[Floats, Floats]:
    """Return half axes (N, 3) in metres and rotations (N, 4; x, y, z, w) of 95 % ellipsoids of covariances (N, 6)."""
    from scipy.spatial.transform import Rotation  # Slow to import, and only this format needs it.

    if not len(covariance_m2):
        return np.empty((0, 3)), np.empty((0, 4))
    variance, direction = np.linalg.eigh(covariance_matrices(covariance_m2))
    direction[np.linalg.det(direction) < 0.0] *= -1.0  # A rotation, not a reflection.
    half_sizes_m: Floats = _SIGMAS_95 * np.sqrt(np.maximum(variance, 0.0))
    return half_sizes_m, Rotation.from_matrix(direction).as_quat()


def _tracks(dataset: Dataset) -> list[Floats]:
    """Return what was driven as strips of points (n, 3)."""
    images = dataset.images
    drives = find_drives(images)
    order = np.lexsort((images.image_id, drives.order, drives.pass_code))
    center = camera_centers(images)[order]
    pass_code = drives.pass_code[order]
    step = np.linalg.norm(np.diff(center, axis=0), axis=1)
    return list(np.split(center, np.flatnonzero((np.diff(pass_code) != 0) | (step > _GAP_M)) + 1))


def _votes(result: Map, dataset: Dataset) -> tuple[Floats, Ints]:
    """Return a line (N, 2, 3) for each vote, from the camera to the label, and the number (N) of its pass."""
    votes, labels = result.votes, result.labels
    image_row = rows_of(votes.image_id, dataset.images.image_id)
    label_row = np.searchsorted(labels.label_id, votes.label_id)
    lines = np.stack([camera_centers(dataset.images)[image_row], labels.position_in_world_m[label_row]], axis=1)
    return lines, number_passes(dataset.images)[image_row]
