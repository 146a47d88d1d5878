"""Real street plans as cities of the simulator: drives over the lanes of San Francisco, panoramas of Dublin.

What cars drove past is not hidden: houses stand wherever nobody drives within some distance. The ground is flat.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import csv
from scipy.spatial import KDTree

from bound import Views
from field_data import PANORAMA_SIZE_PX, enu, panorama_camera
from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import rows_of
from valuemap.errors import InputError
from valuemap.progress import Progress
from valuemap.simulate import Recording, record_drives
from valuemap.simulate.city import City
from valuemap.simulate.drives import Frames
from valuemap.simulate.rows import join_rows
from valuemap.simulate.sightings import Sightings
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Hills, Streets
from valuemap.simulate.targets import CLASSES, Targets

CELL_M = 1.0
FREE_AROUND_TARGETS_M = 4.0
"""No house stands nearer to what is looked at than this."""

LIGHT_ABOVE_M = 5.0
"""Height of the lights of San Francisco: that of the file is wrong."""
LANE_HALF_WIDTH_M = 8.0
"""From the middle of a lane to the houses."""
CHORD_M = 1.5
"""A car looks from so far behind to so far ahead of itself."""

PANORAMA_TO_HOUSES_M = 12.0
"""From a panorama to the houses, a little more than half a street of Dublin."""
PANORAMA_ABOVE_M = 2.5
POLE_HEAD_ABOVE_M = (3.0, 0.2)
"""Height of heads on poles, mean and standard deviation."""
LOWER_HEAD_M = (0.9, 1.1)
"""How far below the head of a pole its second one is."""
DAYS_A_MONTH = 30.4
BAND_HEIGHT_PX = PANORAMA_SIZE_PX[1] // 2
"""The detector finds things between 45 degrees below and above the horizon."""
PX_PER_RAD = PANORAMA_SIZE_PX[0] / (2.0 * np.pi)


@dataclass(frozen=True, eq=False)
class DrivenStreets(Streets):
    """Streets where somebody drove: houses are farther than `half_width_m` from all points `driven_m` (N, 2)."""

    driven_m: Floats

    @cached_property
    def _corner_m(self) -> Floats:
        """The low corner of the raster of what is open."""
        return np.asarray(self.driven_m.min(axis=0) - 2.0 * self.half_width_m)

    @cached_property
    def _is_open(self) -> Bools:
        """Which cells (x, y) of a raster are free of houses."""
        size_m = np.ptp(self.driven_m, axis=0) + 4.0 * self.half_width_m
        shape = tuple(np.ceil(size_m / CELL_M).astype(int).tolist())
        middle = self._corner_m + CELL_M * (np.moveaxis(np.indices(shape), 0, -1) + 0.5)
        reach_m = self.half_width_m + 0.1
        away_m, _ = KDTree(self.driven_m).query(middle.reshape(-1, 2), distance_upper_bound=reach_m)
        return np.asarray(away_m <= self.half_width_m).reshape(shape)

    def is_hidden_by_houses(self, from_m: Floats, to_m: Floats) -> Bools:
        """Return whether a house stands between points (N, 2) and (N, 2) of the ground."""
        length_m = np.maximum(np.linalg.norm(to_m - from_m, axis=1), 1e-9)
        share = np.maximum(1.0 - FREE_AROUND_TARGETS_M / length_m, 0.0)
        hidden = np.zeros(len(from_m), dtype=np.bool_)
        samples = int(np.ceil(length_m.max(initial=0.0) / CELL_M))
        for part in (np.arange(samples) + 0.5) / max(samples, 1):
            point = from_m + (part * share)[:, None] * (to_m - from_m)
            cell = np.floor((point - self._corner_m) / CELL_M).astype(int)
            is_inside = np.all((cell >= 0) & (cell < self._is_open.shape), axis=1)
            cell[~is_inside] = 0
            hidden |= ~(is_inside & self._is_open[cell[:, 0], cell[:, 1]])
        return hidden


def city_of(lights: Targets, driven_m: Floats, half_width_m: float) -> City:
    """Return a flat city of these lights and nothing else, whose streets are where somebody drove (N, 2)."""
    nothing = np.empty(0)
    streets = DrivenStreets(
        x_m=nothing,
        y_m=nothing,
        half_width_m=half_width_m,
        popularity=np.empty((0, 0, 4)),
        hills=Hills(amplitude_m=0.0, wave_vector=np.zeros((1, 2)), phase_rad=np.zeros(1)),
        driven_m=driven_m,
    )
    none = lights.take(np.empty(0, np.int64))
    return City(streets, np.empty((0, 0, 4), np.bool_), lights=lights, roadside=none, lookalikes=none)


def lights_at(
    position_in_world_m: Floats, facing_rad: Floats, size_m: tuple[float, float], *, is_round: bool
) -> Targets:
    """Return traffic lights of one size (width, height) at positions (N, 3) that face (N)."""
    count = len(position_in_world_m)
    return Targets(
        position_in_world_m=position_in_world_m,
        facing_rad=facing_rad,
        size_m=np.tile(size_m, (count, 1)),
        recall_share=np.ones(count),
        pass_row=np.full(count, -1),
        class_code=np.full(count, CLASSES.index("traffic_light")),
        is_round=np.full(count, is_round),
        uneven_m=np.zeros((count, 4)),
    )


def frames_of(pass_row: int, distance_m: Floats, start_s: float, center_in_world_m: Floats, heading_rad: Floats,
              config: SimulationConfig) -> Frames:  # fmt: skip
    """Return the exposures of one pass at distances (N) along it, without faults of time."""
    count = len(distance_m)
    zeros, whole_zeros, places = np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 3))
    return Frames(
        pass_row=np.full(count, pass_row),
        distance_m=distance_m,
        time_s=start_s + distance_m / config.speed_mps,
        signal_ahead_m=zeros,
        center_in_world_m=center_in_world_m,
        heading_rad=heading_rad,
        pitch_rad=np.full(count, np.radians(config.camera_pitch_deg)),
        camera_row=whole_zeros,
        exposure_row=whole_zeros,
        late_m=places,
        late_rad=zeros,
        readout_m=places,
        readout_rad=zeros,
    )


def join_passes(passes: Sequence[Frames]) -> Frames:
    """Return the exposures of all passes in one table."""
    frames = join_rows(passes)
    return frames.replace(exposure_row=np.arange(len(frames)))


# San Francisco.


def san_francisco(data_dir: Path, config: SimulationConfig, tours: float, *, seed: int) -> Recording:
    """Record drives over real lanes, `tours` times as long as all lanes together, past the real signals."""
    lanes, signals = (_read_json(data_dir / name) for name in ("lanes.json", "signals.json"))
    boundary = np.array([signal["boundary"] for signal in signals["signals"]])
    corner_m = np.array(lanes[0]["curve"][0][:2])
    position_m = boundary.mean(axis=1)[:, :2] - corner_m
    across = boundary[:, 0, :2] - boundary[:, 1, :2]
    # Seen from before it, the first corner of a signal is on the left of the second.
    facing_rad = np.arctan2(across[:, 0], -across[:, 1])
    lights = lights_at(
        np.column_stack([position_m, np.full(len(position_m), LIGHT_ABOVE_M)]),
        facing_rad,
        (float(np.linalg.norm(across, axis=1).mean()), float(np.ptp(boundary[:, :, 2], axis=1).mean())),
        is_round=False,
    )
    curves = [np.array(lane["curve"])[:, :2] - corner_m for lane in lanes]
    routes = routes_over_lanes(lanes, tours, config.pass_length_m, seed=seed)
    random = random_stream(seed, "layout", "drives")
    passes = [_drive_lanes([curves[lane] for lane in route], row, config, random) for row, route in enumerate(routes)]
    driven_m = np.concatenate([_resampled(curve, CELL_M)[0] for curve in curves])
    city = city_of(lights, driven_m, LANE_HALF_WIDTH_M)
    return record_drives(city, join_passes(passes), config, seed=seed, name="san-francisco")


def routes_over_lanes(
    lanes: Sequence[dict[str, Any]], tours: float, pass_length_m: float, *, seed: int
) -> list[list[int]]:
    """Return routes, rows of lanes one after the other, that together are `tours` times as long as all lanes.

    Each starts in one of the lanes that were driven least, and goes on in that of its successors.
    """
    random = random_stream(seed, "layout", "routes")
    row_of = {lane["id"]: row for row, lane in enumerate(lanes)}
    after = [[row_of[name] for name in lane["succ"]] for lane in lanes]
    length_m = np.array([lane["length"] for lane in lanes])
    driven = np.zeros(len(lanes), dtype=np.int64)

    def least_driven(rows: Ints) -> int:
        return int(random.choice(rows[driven[rows] == driven[rows].min()]))

    routes: list[list[int]] = []
    left_m = tours * float(length_m.sum())
    while left_m > 0.0:
        route = [least_driven(np.arange(len(lanes)))]
        driven[route[0]] += 1
        while after[route[-1]] and length_m[route].sum() < pass_length_m:
            route.append(least_driven(np.array(after[route[-1]])))
            driven[route[-1]] += 1
        left_m -= float(length_m[route].sum())
        routes.append(route)
    return routes


def _drive_lanes(curves: list[Floats], pass_row: int, config: SimulationConfig, random: np.random.Generator) -> Frames:
    line, distance_m = _resampled(np.concatenate(curves), 0.5)
    at_m = np.arange(random.uniform(0.0, config.frame_spacing_m), distance_m[-1], config.frame_spacing_m)
    place, behind, ahead = (
        np.column_stack([np.interp(at_m + shift_m, distance_m, line[:, axis]) for axis in (0, 1)])
        for shift_m in (0.0, -CHORD_M, CHORD_M)
    )
    heading_rad = np.arctan2(*(ahead - behind).T[::-1])
    center = np.column_stack([place, np.full(len(place), config.camera_height_m)])
    return frames_of(pass_row, at_m, (pass_row + float(random.random())) * 86_400.0, center, heading_rad, config)


def _resampled(curve: Floats, step_m: float) -> tuple[Floats, Floats]:
    """Return points (N, 2) of a line of corners, and how far along it they are (N)."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at_m = np.linspace(0.0, along_m[-1], int(np.ceil(along_m[-1] / step_m)) + 1)
    return np.column_stack([np.interp(at_m, along_m, curve[:, axis]) for axis in (0, 1)]), at_m


def _read_json(path: Path) -> Any:
    return json.loads(_existing(path).read_text(encoding="utf-8"))


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder that holds the folders of both cities")
    return path


# Dublin.


def dublin(data_dir: Path, config: SimulationConfig, year: int, second_head_share: float, *, seed: int) -> Recording:
    """Record the panoramas that show the poles of a survey, of 2015 or 2017, at their real places in real months.

    Poles are seen from all sides. `second_head_share` of them have another head a metre lower.
    """
    lat, lon, month = _panoramas(data_dir, year)
    poles = _columns(data_dir / f"DublinTL_{year}.csv", "\t", 1)
    anchor = float(np.median(lat)), float(np.median(lon)), 0.0
    place_m, pole_m = enu(lat, lon, anchor)[:, :2], enu(poles[1], poles[0], anchor)[:, :2]

    random = random_stream(seed, "layout", "poles")
    mean_m, sigma_m = POLE_HEAD_ABOVE_M
    above_m = mean_m + sigma_m * random.standard_normal(len(pole_m))
    has_second = random.random(len(pole_m)) < second_head_share
    lower_m = random.uniform(*LOWER_HEAD_M, len(pole_m))
    heads = np.column_stack([
        np.concatenate([pole_m, pole_m[has_second]]), np.concatenate([above_m, (above_m - lower_m)[has_second]])
    ])  # fmt: skip
    lights = lights_at(heads, np.zeros(len(heads)), (config.light_width_m, config.light_height_m), is_round=True)
    months = np.unique(month)
    passes = [_drive_panoramas(place_m[month == m], row, float(m), config) for row, m in enumerate(months)]
    recording = record_drives(
        city_of(lights, place_m, PANORAMA_TO_HOUSES_M),
        join_passes(passes),
        config,
        seed=seed,
        name=f"dublin-{year}",
        look=see_in_panoramas,
    )
    # The detector's pictures are the middle of panoramas.
    dataset, cameras = recording.dataset, panorama_camera()
    center_px = recording.dataset.detections.center_px + [0.0, (PANORAMA_SIZE_PX[1] - BAND_HEIGHT_PX) / 2.0]
    images = dataset.images.replace(camera_id=np.full(len(dataset.images), cameras.camera_id[0]))
    detections = dataset.detections.replace(center_px=center_px)
    changed = dataclasses.replace(dataset, cameras=cameras, images=images, detections=detections)
    return dataclasses.replace(recording, dataset=changed)


def _panoramas(data_dir: Path, year: int) -> tuple[Floats, Floats, Ints]:
    """Return latitude and longitude (N) of the panoramas of a survey, and their months (N) since the year 0."""
    if year == 2015:  # The survey has a list of its own.
        lat, lon, _, taken, month = _columns(data_dir / "gsvs_2015.csv", ",", 0)
        rows = np.ones(len(lat), np.bool_)
    else:
        lat, lon, _, taken, month = _columns(data_dir / "gsvs_all.csv", ",", 1)
        rows = taken == year
    return lat[rows].astype(np.float64), lon[rows].astype(np.float64), (12 * taken + month - 1)[rows]


def _columns(path: Path, delimiter: str, header_lines: int) -> list[NDArray[Any]]:
    if delimiter == "\t":  # Tabs or blanks, in one and the same file.
        return list(np.loadtxt(_existing(path), skiprows=header_lines).T)
    table = csv.read_csv(_existing(path), csv.ReadOptions(skip_rows=header_lines, autogenerate_column_names=True))
    return [column.to_numpy() for column in table.columns]


def _drive_panoramas(place_m: Floats, pass_row: int, month: float, config: SimulationConfig) -> Frames:
    """Return the panoramas (N, 2) of a month, in the order in which the next is the nearest that is left."""
    left = np.ones(len(place_m), np.bool_)
    order = [int(np.lexsort(place_m.T)[0])]
    left[order[0]] = False
    while left.any():
        rows = np.flatnonzero(left)
        order.append(int(rows[np.argmin(np.linalg.norm(place_m[rows] - place_m[order[-1]], axis=1))]))
        left[order[-1]] = False
    place = place_m[order]
    step_m = np.diff(place, axis=0, prepend=place[:1])
    distance_m = np.cumsum(np.linalg.norm(step_m, axis=1))
    center = np.column_stack([place, np.full(len(place), config.camera_height_m)])
    heading_rad = np.arctan2(step_m[:, 1], step_m[:, 0])
    return frames_of(pass_row, distance_m, month * DAYS_A_MONTH * 86_400.0, center, heading_rad, config)


def see_in_panoramas(
    targets: Targets, frames: Frames, streets: Streets, config: SimulationConfig, *, progress: Progress, what: str
) -> Sightings:
    """Return all views of targets in level panoramas; the picture is the band around the horizon."""
    progress(what, 0, 1)
    away = targets.position_in_world_m - frames.center_in_world_m[:, None]
    on_ground_m = np.hypot(away[..., 0], away[..., 1])
    only_pass = targets.pass_row
    is_met = (only_pass < 0) | (only_pass == frames.pass_row[:, None])
    frame_row, target_row = np.nonzero((on_ground_m <= config.max_sight_m) & (on_ground_m > 1.0) & is_met)
    away, on_ground_m = away[frame_row, target_row], on_ground_m[frame_row, target_row]
    to_right_rad = frames.heading_rad[frame_row] - np.arctan2(away[:, 1], away[:, 0])
    to_right_rad = np.remainder(to_right_rad + np.pi, 2.0 * np.pi) - np.pi
    up_rad = np.arctan2(away[:, 2], on_ground_m)
    picture_px = np.array([PANORAMA_SIZE_PX[0], BAND_HEIGHT_PX])
    from_middle_px = PX_PER_RAD * np.column_stack([to_right_rad, -up_rad])
    size_px = PX_PER_RAD * targets.size_m[target_row] / np.linalg.norm(away, axis=1)[:, None]
    # The picture's edges, at the back and above, cut nothing: what they touch is not seen.
    rows = np.flatnonzero(np.all(np.abs(from_middle_px) <= (picture_px - size_px) / 2.0, axis=1))
    center = frames.center_in_world_m[frame_row[rows], :2]
    rows = rows[~streets.is_hidden_by_houses(center, targets.position_in_world_m[target_row[rows], :2])]
    progress(what, 1, 1)
    return Sightings(
        frame_row[rows],
        target_row[rows],
        picture_px / 2.0 + from_middle_px[rows],
        size_px[rows],
        np.zeros(len(rows), np.bool_),
    )


def views_in_panoramas(recording: Recording) -> Views:
    """Return what `bound.true_views` does with pinholes: detections of lights with derivatives of directions."""
    dataset, config = recording.dataset, recording.config
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    object_row = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    detection = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    frames = recording.frames.take(rows_of(dataset.detections.image_id[detection], dataset.images.image_id))
    objects = recording.city.objects
    x, y, z = (objects.position_in_world_m[object_row] - frames.center_in_world_m).T
    ground, whole = np.hypot(x, y), x**2 + y**2 + z**2
    to_right = np.stack([y, -x, np.zeros_like(x)], axis=1) / ground[:, None] ** 2
    down = np.stack([x * z / ground, y * z / ground, -ground], axis=1) / whole[:, None]
    height_px = PX_PER_RAD * objects.size_m[object_row, 1] / np.sqrt(whole)
    views = Views(
        object_row=object_row,
        pass_row=frames.pass_row,
        distance_m=frames.distance_m,
        of_point=PX_PER_RAD * np.stack([to_right, down], axis=1),
        of_turn=np.zeros((len(x), 2, 3)),
        pixel_sigma=np.hypot(config.pixel_noise_px, config.pixel_noise_share * height_px),
        exposure_row=frames.exposure_row,
    )
    return views.take(np.lexsort((views.distance_m, views.pass_row, views.object_row)))
