"""From a folder of rendered street pictures with a GPS position in each, and nothing else, to poses and a map.

    python benchmarks/pictures.py [--seed 1] [--pass-row 1] [--pictures N] [--gps-sigma 2] [--spacing 2.5]
                                  [--camera WIDTH HEIGHT FOCAL] [--work DIR] [--json FILE]

A drive round the blocks of a simulated city by day is rendered. EXIF gets a position with noise of `--gps-sigma` on
each axis, the time and the focal length. `valuemap import pictures` finds the poses. They are compared with the true
ones, in the world: how many there are, how wrong the way from a picture to those 40 to 60 m away is, and how the errors
compare with their sigmas. Then the bundled detector runs on the pictures, and the map of its detections is made twice,
with the true poses and with those found.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from machine import describe_machine, keep_record
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.dataset import Dataset, Frame, read_dataset, write_dataset
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import read_map
from valuemap.simulate import PRESETS, Recording, record_city
from valuemap.simulate.render import render_pictures
from valuemap.simulate.weather import light_of_pass

ANCHOR = (52.0, 4.0, 40.0)
CITY = (
    "streets_north_south=2",
    "streets_east_west=2",
    "passes_per_street=1",
    "signalised_share=1",
    "lights=14",
    "lights_per_approach=1.5",
    "keep_before_signal_m=1000",
    "red_light_share=0.2",
    "standing_interval_s=2",
    "position_white_m=0",
    "position_drift_m=0",
    "rotation_white_deg=0",
    "rotation_drift_deg=0",
)
START_S = 1.7e9
GPS_SIGMA_M = 2.0
SPACING_M = 2.5
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_CAMERA = ("WIDTH", "HEIGHT", "FOCAL")


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description="poses and a map from rendered pictures with GPS positions")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pass-row", type=int, default=1, help="which drive; the default is by day")
    parser.add_argument("--pictures", type=int, default=1000, help="of its beginning; the default is the whole drive")
    parser.add_argument("--gps-sigma", type=float, default=GPS_SIGMA_M, help="noise of each axis, m")
    parser.add_argument("--spacing", type=float, default=SPACING_M, help="way from picture to picture, m")
    parser.add_argument("--camera", nargs=3, type=float, metavar=_CAMERA, help="px; the default is the simulator's")
    parser.add_argument("--work", type=Path, help="folder for everything, to go on after an interruption")
    parser.add_argument("--json", type=Path, help="file to write the figures to, beside those of other drives")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        result = run(work, options)
    for name, value in result.items():
        print(f"{name}: {value}")
    keep_record(options.json, record_of(options, result))


def record_of(options: argparse.Namespace, result: dict[str, Any]) -> dict[str, Any]:
    """Return what is kept: this drive beside the others that the file has."""
    is_there = options.json is not None and options.json.is_file()
    others = json.loads(options.json.read_text(encoding="utf-8"))["results"] if is_there else {}
    drive = f"seed {options.seed}, pass {options.pass_row}"
    if options.gps_sigma != GPS_SIGMA_M:
        drive += f", GPS of {options.gps_sigma:g} m"
    if options.spacing != SPACING_M:
        drive += f", every {options.spacing:g} m"
    if options.camera:
        drive += ", {:g} x {:g} px, focal length {:g} px".format(*options.camera)
    return {
        "benchmark": "pictures",
        "command": "python benchmarks/pictures.py --seed SEED --pass-row PASS --json FILE, drive by drive",
        **describe_machine(),
        "results": dict(sorted({**others, drive: result}.items())),
    }


def run(work: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return all figures."""
    work.mkdir(parents=True, exist_ok=True)
    seed, pass_row, gps_sigma_m = options.seed, options.pass_row, options.gps_sigma
    city = (*CITY, f"frame_spacing_m={options.spacing:g}", *_settings_of_camera(options.camera or []))
    recording = record_city(PRESETS["small"].with_settings(city), seed=seed)
    rows = np.flatnonzero(recording.frames.pass_row == pass_row)[: options.pictures]
    photos, truth, found = work / "photos", work / "truth", work / "found"
    names = take_photos(recording, rows, photos, gps_sigma_m)
    start = time.perf_counter()
    valuemap("import", "pictures", str(photos), "--out", str(found), "--force")
    seconds = time.perf_counter() - start
    images = recording.dataset.images
    true = Dataset(
        name="truth",
        frame=Frame(anchor=ANCHOR),
        cameras=recording.dataset.cameras,
        images=images.take(np.isin(images.name.to_pylist(), names)),
        detections=recording.dataset.detections.take(np.zeros(len(recording.dataset.detections), dtype=np.bool_)),
        truth=recording.dataset.truth,
    )
    write_dataset(true, truth, force=True)
    result = {
        "city": list(city),
        "seed": seed,
        "weather": light_of_pass(pass_row, seed=seed).weather.name,
        "gps_sigma_m": gps_sigma_m,
        "pictures": len(names),
        "relative_error_that_the_gps_alone_leaves_m": figures(
            relative_errors(
                gps_error_of_true_shape(recording, rows, gps_sigma_m), recording.frames.center_in_world_m[rows]
            )
        ),
        **compare_poses(true, read_dataset(found)),
        "import_seconds": round(seconds, 1),
    }
    valuemap("detect", str(truth), "--images", str(photos), "--model", "bundled")
    write_dataset(with_detections(read_dataset(found), read_dataset(truth)), found, force=True)
    for dataset in (truth, found):
        valuemap("map", str(dataset), "--out", str(dataset.with_name(f"{dataset.name}-map")), "--force")
    lights = recording.city.lights.position_in_world_m
    judged = {dataset.name: judge(dataset, lights) for dataset in (truth, found)}
    ratio = judged["found"]["recall"] / max(judged["truth"]["recall"], 1e-9)
    return {**result, "map": judged, "recall_over_that_of_true_poses": round(ratio, 3)}


def _settings_of_camera(camera: list[float]) -> list[str]:
    """Return the simulator's settings for width, height and focal length in pixels, where they are given."""
    names = ("image_width_px", "image_height_px", "focal_px")
    return [f"{name}={value:g}" for name, value in zip(names, camera, strict=False)]


def with_detections(found: Dataset, detected: Dataset) -> Dataset:
    """Return a dataset with what was detected in the same pictures of another: a detector knows nothing of poses."""
    id_of = dict(zip(found.images.name.to_pylist(), found.images.image_id.tolist(), strict=True))
    named = zip(detected.images.image_id.tolist(), detected.images.name.to_pylist(), strict=True)
    new_id = {image_id: id_of[name] for image_id, name in named if name in id_of}
    boxes = detected.detections.take(np.isin(detected.detections.image_id, list(new_id)))
    ids = np.array([new_id[image_id] for image_id in boxes.image_id.tolist()], dtype=np.int64)
    return dataclasses.replace(found, detections=boxes.replace(image_id=ids))


def valuemap(*arguments: str) -> None:
    """Run a command as a user does."""
    subprocess.run([sys.executable, "-m", "valuemap", *arguments], check=True)


def take_photos(recording: Recording, rows: Any, folder: Path, gps_sigma_m: float) -> list[str]:
    """Write pictures with what a telephone would say of them; return their names."""
    images = recording.dataset.images
    place = lon_lat_height_from_enu(gps_positions(recording, gps_sigma_m), ANCHOR)
    config, names = recording.config, images.name.to_pylist()
    missing = [row for row in rows.tolist() if not (folder / names[row]).is_file()]
    for picture in render_pictures(recording, rows=missing):
        path, row = folder / picture.name, picture.row
        path.parent.mkdir(parents=True, exist_ok=True)
        lon, lat, height = place[row].tolist()
        moment = datetime.fromtimestamp(START_S + recording.frames.time_s[row], UTC)
        exif = Image.Exif()
        exif[Base.Software] = "valuemap"
        exif._ifds[IFD.GPSInfo] = {
            GPS.GPSLatitudeRef: "N",
            GPS.GPSLatitude: sexagesimal(lat),
            GPS.GPSLongitudeRef: "E",
            GPS.GPSLongitude: sexagesimal(lon),
            GPS.GPSAltitudeRef: b"\x00",
            GPS.GPSAltitude: height,
            GPS.GPSHPositioningError: gps_sigma_m,
            GPS.GPSDateStamp: moment.strftime("%Y:%m:%d"),
            GPS.GPSTimeStamp: (float(moment.hour), float(moment.minute), moment.second + moment.microsecond / 1e6),
        }
        film_mm = round(FILM_DIAGONAL_MM * config.focal_px / math.hypot(config.image_width_px, config.image_height_px))
        exif._ifds[IFD.Exif] = {Base.FocalLengthIn35mmFilm: film_mm}
        Image.fromarray(picture.image).save(path, exif=exif, quality=92)
    return [names[row] for row in rows.tolist()]


def gps_positions(recording: Recording, sigma_m: float) -> Floats:
    """Return where the GPS says that pictures (N, 3) were taken."""
    center: Floats = recording.frames.center_in_world_m
    return center + np.random.default_rng(recording.seed).normal(0.0, sigma_m, center.shape)


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Return degrees, minutes and seconds."""
    minutes = (degrees - int(degrees)) * 60.0
    return float(int(degrees)), float(int(minutes)), (minutes - int(minutes)) * 60.0


def compare_poses(true: Dataset, found: Dataset) -> dict[str, Any]:
    """Return how many poses there are and how wrong they are."""
    row_of = {name: row for row, name in enumerate(true.images.name.to_pylist())}
    row = np.array([row_of[name] for name in found.images.name.to_pylist()])
    assert found.frame.anchor is not None
    center = enu_from_lon_lat_height(lon_lat_height_from_enu(camera_centers(found.images), found.frame.anchor), ANCHOR)
    true_center = camera_centers(true.images)[row]
    error = center - true_center
    turned = np.einsum("nij,nkj->nik", rotation_matrices(found.images), rotation_matrices(true.images)[row])
    turned_rad = Rotation.from_matrix(turned).magnitude()
    assert found.images.position_sigma_m is not None
    assert found.images.rotation_sigma_rad is not None
    in_part = rigid_rest(center, true_center)
    return {
        "posed": len(row),
        "posed_share": round(len(row) / len(true.images), 3),
        "passes": len(found.images.pass_id.names),
        "focal_px": [round(float(params[0]), 1) for params in found.cameras.params],
        "position_error_m": figures(np.linalg.norm(error, axis=1)),
        "rotation_error_deg": figures(np.degrees(turned_rad)),
        "relative_error_40_to_60_m_m": figures(relative_errors(error, true_center)),
        "position_sigma_m": figures(found.images.position_sigma_m),
        "position_error_after_moving_the_whole_m": figures(in_part),
        "position_error_over_sigma_rms": round(
            float(np.sqrt(np.mean((in_part / found.images.position_sigma_m) ** 2) / 3.0)), 2
        ),
    }


def relative_errors(error_m: Floats, true_m: Floats) -> Floats:
    """Return how wrong the ways are between positions (N, 3) that are 40 to 60 m apart."""
    apart = np.linalg.norm(true_m[:, None] - true_m[None], axis=2)
    near = (apart > 40.0) & (apart < 60.0)
    between: Floats = np.linalg.norm(error_m[:, None] - error_m[None], axis=2)[near]
    return between


def moved_onto(target_m: Floats, shape_m: Floats) -> Floats:
    """Return a shape (N, 3) moved, turned and scaled to where it is nearest to others (Umeyama, 1991)."""
    a, b = shape_m - shape_m.mean(axis=0), target_m - target_m.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    scale = (b * turn.apply(a)).sum() / (a**2).sum()
    moved: Floats = scale * turn.apply(a) + target_m.mean(axis=0)
    return moved


def rigid_rest(center_m: Floats, true_m: Floats) -> Floats:
    """Return how far positions (N, 3) are from the true ones where the whole is moved, turned and scaled."""
    rest: Floats = np.linalg.norm(moved_onto(center_m, true_m) - center_m, axis=1)
    return rest


def gps_error_of_true_shape(recording: Recording, rows: Any, sigma_m: float) -> Floats:
    """Return the errors (N, 3) of who knows the shape of a drive and has its place, turn and scale from the GPS.

    Pictures say nothing of these three: no structure from motion is better than that, but by chance.
    """
    true_m: Floats = recording.frames.center_in_world_m[rows]
    return moved_onto(gps_positions(recording, sigma_m)[rows], true_m) - true_m


def figures(values: Floats) -> dict[str, float]:
    """Return the median, and what 90 and 100 % are below."""
    names = ("median", "p90", "max")
    return dict(zip(names, np.round(np.percentile(values, [50, 90, 100]), 4).tolist(), strict=True))


def judge(dataset: Path, lights_in_world_m: Floats) -> dict[str, float]:
    """Return what a map has of the lights (N, 3), one to one within 2 m on the ground, and its precision."""
    made = read_map(dataset.with_name(f"{dataset.name}-map"))
    assert made.frame.anchor is not None
    place = enu_from_lon_lat_height(lon_lat_height_from_enu(made.labels.position_in_world_m, made.frame.anchor), ANCHOR)
    away = np.linalg.norm(place[:, None, :2] - lights_in_world_m[None, :, :2], axis=2)
    first, second = linear_sum_assignment(np.minimum(away, 10.0))
    right = away[first, second] < 2.0
    return {
        "labels": len(place),
        "lights": int(right.sum()),
        "recall": round(float(right.sum()) / len(lights_in_world_m), 3),
        "precision": round(float(right.sum()) / max(len(place), 1), 3),
        "median_error_m": round(float(np.median(away[first, second][right])), 3) if right.any() else float("nan"),
    }


if __name__ == "__main__":
    main()
