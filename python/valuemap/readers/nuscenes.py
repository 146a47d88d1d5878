"""nuScenes: JSON tables that point to each other by tokens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_folder, file_in, read_json
from valuemap.readers.json_values import Json
from valuemap.readers.names import match_images
from valuemap.readers.poses import make_images, rotations_of_quaternions
from valuemap.readers.reader import Reader

_EXPECTED = "a folder of nuScenes' tables, such as v1.0-trainval, with sample_data.json and ego_pose.json"
_ORIGINS = {
    "boston-seaport": (42.336849169438615, -71.05785369873047, 0.0),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984, 0.0),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555, 0.0),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758, 0.0),
}
"""Latitude and longitude of the south-west corner of each map, the origin of its poses."""
_MICRO = 1e-6

T = TypeVar("T")


@Reader
def read_nuscenes(
    tables: Path,
    *,
    detections: DetectionFile | Path | None = None,
    location: str | None = None,
    sweeps: bool = False,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read the cameras of all scenes of one location; every image has the ego pose of its own instant.

    An image is named by its `filename` and is of the pass of its scene; the key frames of one sample are a rig. The
    height of the ego pose is always 0, so heights are above the road, and the anchor's height is 0 unless given.

    Parameters
    ----------
    tables
        The folder of the JSON tables.
    detections
        As in `read_detections`.
    location
        Which map, where there are several, such as `boston-seaport`: their frames have nothing to do with each other.
    sweeps
        Take the images between the key frames too.
    up, anchor, max_rejected
        As in `assemble`; the origins of nuScenes' four maps are known.

    Raises
    ------
    InputError
        A table is missing or damaged, or a token leads nowhere.
    SettingError
        There is no such location, or several and none is chosen.
    """
    check_folder(tables, _EXPECTED)
    progress("reading the tables", 0, 2)
    scene_of = _by_token(tables, "scene")
    location_of = {key: log["location"].text() for key, log in _by_token(tables, "log").items()}
    place_of_scene = {key: _follow(scene["log_token"], location_of) for key, scene in scene_of.items()}
    location = _choose(location, sorted(set(place_of_scene.values())), tables)
    scene_of_sample = {
        key: sample["scene_token"].text() if _follow(sample["scene_token"], place_of_scene) == location else ""
        for key, sample in _by_token(tables, "sample").items()
    }
    channel_of = {
        key: sensor["channel"].text()
        for key, sensor in _by_token(tables, "sensor").items()
        if sensor["modality"].text() == "camera"
    }
    calibrated = _by_token(tables, "calibrated_sensor")
    poses = _by_token(tables, "ego_pose")
    names, camera_of, passes, rigs, time, quaternions, offsets = [], [], [], [], [], [], []
    not_chosen: list[str] = []
    for row in _rows(tables, "sample_data"):
        sensor = _follow(row["calibrated_sensor_token"], calibrated)
        scene = _follow(row["sample_token"], scene_of_sample)
        is_key = row["is_key_frame"].value is True
        if sensor["sensor_token"].text() not in channel_of:
            continue
        if not scene or not (is_key or sweeps):
            not_chosen.append(row["filename"].text())
            continue
        ego = _follow(row["ego_pose_token"], poses)
        names.append(row["filename"].text())
        intrinsic = sensor["camera_intrinsic"].matrix(3, 3)
        params = (intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2] + 0.5, intrinsic[1, 2] + 0.5)
        camera_of.append(Camera("PINHOLE", row["width"].whole(), row["height"].whole(), tuple(map(float, params))))
        passes.append(scene_of[scene]["name"].text())
        rigs.append(row["sample_token"].text() if is_key else names[-1])
        time.append(row["timestamp"].number() * _MICRO)
        quaternions.append([ego["rotation"].known_numbers(4), sensor["rotation"].numbers(4)])
        offsets.append([ego["translation"].known_numbers(3), sensor["translation"].numbers(3)])
    if not names:
        raise InputError(f"{tables}: there is no image of a camera", hint=f"expected {_EXPECTED}")
    quaternion, offset = np.array(quaternions), np.array(offsets)
    world_from_ego = rotations_of_quaternions(quaternion[:, 0])
    ego_from_cam = rotations_of_quaternions(quaternion[:, 1])
    cameras, camera_id = make_cameras(camera_of, str(tables))
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=world_from_ego @ ego_from_cam,
        center_in_world_m=np.einsum("nij,nj->ni", world_from_ego, offset[:, 1]) + offset[:, 0],
        passes=passes,
        source=str(tables),
        timestamp_s=np.array(time),
        rigs=rigs,
    )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=location,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=up,
        anchor=anchor if anchor is not None or up is not None else _ORIGINS.get(location),
        source=str(tables),
        max_rejected=max_rejected,
        not_chosen=lambda missing: match_images(missing, not_chosen),
    )
    progress("reading the detections", 2, 2)
    return dataset


def _rows(tables: Path, name: str) -> list[Json]:
    path = file_in(tables, f"{name}.json", _EXPECTED)
    return list(Json(read_json(path, _EXPECTED), str(path), f"expected {_EXPECTED}").entries())


def _by_token(tables: Path, name: str) -> dict[str, Json]:
    return {row["token"].text(): row for row in _rows(tables, name)}


def _follow(token: Json, table: Mapping[str, T]) -> T:
    if token.text() not in table:
        raise token.wrong("expected a token that is in its table")
    return table[token.text()]


def _choose(location: str | None, known: list[str], tables: Path) -> str:
    if location is None and len(known) == 1:
        return known[0]
    if location is None:
        raise SettingError(
            f"location: expected one, as each map has a frame of its own; {tables} has {', '.join(known) or 'none'}",
            hint="choose one with --location",
        )
    if location not in known:
        raise SettingError(
            f"location {location}: there is none such in {tables}", hint=f"it has {', '.join(known) or 'none'}"
        )
    return location
