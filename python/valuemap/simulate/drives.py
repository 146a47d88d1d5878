"""The drives: when cars move and wait, and where the camera takes its images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, rows_in_runs
from valuemap.config import SimulationConfig
from valuemap.progress import Progress, counted
from valuemap.simulate.city import City
from valuemap.simulate.paths import Path, lay_path
from valuemap.simulate.routes import Route, route_at_random, routes_over_every_street
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Hills
from valuemap.tables import Table

KEEP_RANGE = (0.7, 1.5)
"""How far `keep_before_signal_m` may be bent to meet an aimed number of detections."""

_LANES_M = (1.75, 5.25)
_LANE_JITTER_M = 0.25
_STOP_LINE_M = 14.0
_QUEUE_M = 8.0
_DAY_S = 86_400.0
_CAMERA_FROM_MIDDLE_M = 0.2
"""How far the cameras of a car with several are from the middle of them all."""
_START_OF_DRIVE_DAYS = (0.3, 0.8)


@dataclass(frozen=True, eq=False)
class Frames(Table):
    """True exposures, in the order of passes and time.

    `pass_row` (N) numbers the passes; `distance_m` (N) is driven since the start of the pass; `signal_ahead_m`
    (N) the distance along the street to the next intersection with lights that face the car, 0 in a city without;
    `center_in_world_m` (N, 3) the camera centre; `heading_rad` (N) where it looks, counter-clockwise from east;
    `pitch_rad` (N) how far up; `camera_row` (N) which camera of the car it is, `exposure_row` (N) is one number for all
    that the car's cameras took at one time. `late_m` (N, 3) and `late_rad` (N) say how far the camera moved and turned
    left since the time of the pose that is recorded; `readout_m` (N, 3) and `readout_rad` (N) how far from the exposure
    of the first row of the picture to that of the last one. All else is of the middle row.
    """

    pass_row: Ints
    distance_m: Floats
    time_s: Floats
    signal_ahead_m: Floats
    center_in_world_m: Floats
    heading_rad: Floats
    pitch_rad: Floats
    camera_row: Ints
    exposure_row: Ints
    late_m: Floats
    late_rad: Floats
    readout_m: Floats
    readout_rad: Floats

    def cam_from_world(self) -> Floats:
        """Return rotations (N, 3, 3) into camera axes: x right, y down, z forward."""
        cos_heading, sin_heading = np.cos(self.heading_rad), np.sin(self.heading_rad)
        cos_pitch, sin_pitch = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        right = np.stack([sin_heading, -cos_heading, np.zeros(len(self))], axis=1)
        forward = np.stack([cos_heading * cos_pitch, sin_heading * cos_pitch, sin_pitch], axis=1)
        return np.stack([right, np.cross(forward, right), forward], axis=1)


def drive(city: City, config: SimulationConfig, *, seed: int, progress: Progress) -> Frames:
    """Drive all passes and return their images, without those that are far from any lights ahead.

    Where an aimed number of detections leaves open how far is far, all images that may be needed are returned.
    """
    passes: list[Frames] = []
    with counted(progress, "driving every street", config.passes_per_street) as tell:
        for number in range(config.passes_per_street):
            routes = routes_over_every_street(city.streets, config, seed=seed, round_number=number)
            passes += [_drive_route(route, city, config, seed, len(passes) + i) for i, route in enumerate(routes)]
            tell(number + 1)
    # These images stay, however near the aimed number of detections will have them.
    sure_m = config.keep_before_signal_m * (KEEP_RANGE[0] if config.detections else 1.0)
    images = sum(int(np.count_nonzero(p.signal_ahead_m <= sure_m)) for p in passes)
    if images < config.images:
        with counted(progress, "driving at random", config.images) as tell:
            while images < config.images:
                route = route_at_random(city.streets, config, seed=seed, pass_row=len(passes))
                passes.append(_drive_route(route, city, config, seed, len(passes)))
                images += int(np.count_nonzero(passes[-1].signal_ahead_m <= sure_m))
                tell(images)
    frames = join_rows(passes)
    return frames.replace(exposure_row=np.arange(len(frames)))


def mount_cameras(frames: Frames, config: SimulationConfig) -> Frames:
    """Return the frames of all cameras of the cars, exposure by exposure, from those of cameras that look ahead."""
    if config.cameras == 1:
        return frames
    count = config.cameras
    mounted = frames.take(np.repeat(np.arange(len(frames)), count))
    camera_row = np.tile(np.arange(count), len(frames))
    turn_rad = np.radians(config.camera_spread_deg) * ((count - 1) / 2.0 - camera_row)
    heading_rad = mounted.heading_rad + turn_rad
    outward = np.stack([np.cos(heading_rad), np.sin(heading_rad), np.zeros(len(mounted))], axis=1)
    # What is uphill for one who looks ahead is level for one who looks to the side.
    level_rad = np.radians(config.camera_pitch_deg)
    return mounted.replace(
        center_in_world_m=mounted.center_in_world_m + _CAMERA_FROM_MIDDLE_M * outward,
        heading_rad=heading_rad,
        pitch_rad=level_rad + (mounted.pitch_rad - level_rad) * np.cos(turn_rad),
        camera_row=camera_row,
    )


def _drive_route(route: Route, city: City, config: SimulationConfig, seed: int, pass_row: int) -> Frames:
    random = random_stream(seed, "pass", pass_row)
    lane_m = random.choice(_LANES_M) + random.uniform(-_LANE_JITTER_M, _LANE_JITTER_M)
    starts_s = (pass_row + random.uniform(*_START_OF_DRIVE_DAYS)) * _DAY_S
    path = lay_path(route, city.streets, lane_m)
    reached = route.intersection[1:]
    has_lights = city.is_signalised[reached[:, 0], reached[:, 1], route.direction]
    distance_m, time_s = _expose(path, *_stops(path, has_lights, config, random), config, random)
    past_m = np.interp(time_s - config.pose_delay_s, time_s, distance_m) if config.pose_delay_s else distance_m
    half_s = 0.5 * config.readout_s
    rows_m = np.stack([np.interp(time_s + late_s, time_s, distance_m) for late_s in (-half_s, half_s)], axis=1)

    ahead_m = _distance_to_next(path.middle_at_m[has_lights], distance_m)
    # Lights round a corner are not ahead.
    ahead_m[_distance_to_next(path.middle_at_m[path.turn != 0], distance_m) < ahead_m] = np.inf
    if not config.has_lights:
        ahead_m = np.zeros(len(distance_m))
    kept = ahead_m <= config.keep_before_signal_m * (KEEP_RANGE[1] if config.detections else 1.0)
    distance_m, time_s, ahead_m, past_m = distance_m[kept], time_s[kept], ahead_m[kept], past_m[kept]
    first_m, last_m = rows_m[kept].T

    ground, heading = path.walk(distance_m)
    hills = city.streets.hills
    rise = (hills.slope(ground) * np.stack([np.cos(heading), np.sin(heading)], axis=1)).sum(axis=1)
    center = np.column_stack([ground, hills.height_m(ground) + config.camera_height_m])
    late_m, late_rad = np.zeros_like(center), np.zeros(len(heading))
    readout_m, readout_rad = late_m, late_rad
    if config.pose_delay_s:
        late_m, late_rad = _moved(path, hills, past_m, distance_m)
    if config.readout_s:
        readout_m, readout_rad = _moved(path, hills, first_m, last_m)
    return Frames(
        pass_row=np.full(len(distance_m), pass_row, dtype=np.int64),
        distance_m=distance_m,
        time_s=starts_s + time_s,
        signal_ahead_m=ahead_m,
        center_in_world_m=center,
        heading_rad=heading,
        pitch_rad=np.arctan(rise) + np.radians(config.camera_pitch_deg),
        camera_row=np.zeros(len(distance_m), dtype=np.int64),
        exposure_row=np.zeros(len(distance_m), dtype=np.int64),
        late_m=late_m,
        late_rad=late_rad,
        readout_m=readout_m,
        readout_rad=readout_rad,
    )


def _moved(path: Path, hills: Hills, from_m: Floats, to_m: Floats) -> tuple[Floats, Floats]:
    """Return how far (N, 3) a camera moves, and turns left (N), between distances (N) along a path."""
    (start, start_rad), (end, end_rad) = path.walk(from_m), path.walk(to_m)
    moved_m = np.column_stack([end - start, hills.height_m(end) - hills.height_m(start)])
    return moved_m, np.asarray(np.angle(np.exp(1j * (end_rad - start_rad))))


def _stops(
    path: Path, has_lights: Bools, config: SimulationConfig, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return where (N) along the path the car waits at a red light, and for how long (N)."""
    count = len(has_lights)
    is_red = random.random(count) < config.red_light_share
    wait_s = config.red_light_s * random.uniform(0.5, 1.5, count)
    before_m = _STOP_LINE_M + random.exponential(_QUEUE_M, count)
    stop_at_m = np.maximum(path.middle_at_m - before_m, path.from_m[:-1])
    waits = has_lights & is_red
    return stop_at_m[waits], wait_s[waits]


def _expose(
    path: Path, stop_at_m: Floats, wait_s: Floats, config: SimulationConfig, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return where along the path (N) and when since its start (N) images are taken, in the order of time."""
    first_m = random.uniform(0.0, config.frame_spacing_m)
    moving_at_m = np.arange(first_m, path.middle_at_m[-1], config.frame_spacing_m)
    waited_s = np.concatenate([[0.0], np.cumsum(wait_s)])
    moving_s = moving_at_m / config.speed_mps + waited_s[np.searchsorted(stop_at_m, moving_at_m)]

    standing = np.floor(wait_s / config.standing_interval_s).astype(np.int64)
    stop = np.repeat(np.arange(len(standing)), standing)
    in_stop = rows_in_runs(0, standing)
    standing_s = stop_at_m[stop] / config.speed_mps + waited_s[stop] + (in_stop + 0.5) * config.standing_interval_s

    distance_m, time_s = np.concatenate([moving_at_m, stop_at_m[stop]]), np.concatenate([moving_s, standing_s])
    order = np.argsort(time_s, kind="stable")
    return distance_m[order], time_s[order]


def _distance_to_next(places_m: Floats, distance_m: Floats) -> Floats:
    """Return how far (N) ahead the next of the places is from distances (N) along a path, or inf."""
    padded = np.concatenate([places_m, [np.inf]])
    ahead_m: Floats = padded[np.searchsorted(places_m, distance_m)] - distance_m
    return ahead_m
