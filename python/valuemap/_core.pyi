"""The numeric core (Rust): arrays in, arrays out; float64, C order, world frame, metres, radians and pixels."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]
_Offsets = NDArray[np.int64]
_Indices = NDArray[np.uint32]

CLASS_FIELDS: list[tuple[str, int]]
CALIBRATION_STEPS: int
FARTHEST_M: float
MISFIT_STEPS: int
SEARCH_STEPS: int
STEPS_OF_ONCE: int

class Rays:
    def __init__(
        self,
        residual_from_cam: _Floats,
        direction_in_cam: _Floats,
        image: _Indices,
        class_: _Indices,
        cam_from_world: _Floats,
        center_in_world_m: _Floats,
        /,
    ) -> None: ...
    def __len__(self) -> int: ...
    def residual_from_world(self) -> _Floats: ...
    def center_in_world_m(self) -> _Floats: ...
    def direction_in_world(self) -> _Floats: ...
    def in_units(self, unit_m: float) -> Rays: ...

def partition(center_in_world_m: _Floats, cluster_radius_m: float) -> _Indices: ...
def vote(
    rays: Rays,
    cluster: _Indices,
    *,
    max_reprojection_error_px: float,
    min_parallax_rad: float,
    min_range_m: float,
    max_range_m: float,
    min_vote_ratio: float,
    min_votes: int,
    threads: int,
    progress: Callable[[int, int], None],
) -> tuple[_Floats, tuple[_Offsets, _Indices], _Indices, dict[str, int]]: ...
def merge(
    rays: Rays,
    point_in_world_m: _Floats,
    voter_offsets: _Offsets,
    voters: _Indices,
    cluster: _Indices,
    merge_radius_m: float,
) -> tuple[_Floats, tuple[_Offsets, _Indices]]: ...
def unit_covariance(rays: Rays, point_in_world_m: _Floats, voter_offsets: _Offsets, voters: _Indices) -> _Floats: ...
def see(
    rays: Rays, point_in_world_m: _Floats, voter_offsets: _Offsets, voters: _Indices
) -> tuple[_Floats, _Floats, _Floats]: ...
def sides(thing: _Indices, direction: _Floats, /) -> _Indices: ...
def medians(values: _Floats, offsets: _Offsets) -> _Floats: ...
def parts() -> list[str]: ...

class Scene:
    def __init__(
        self,
        rays: Rays,
        *,
        box_px: _Floats,
        score: _Floats,
        range_m: _Floats,
        range_sigma_m: _Floats,
        center_in_world_m: _Floats,
        cam_from_world: _Floats,
        camera: _Indices,
        pass_code: _Indices,
        viewpoint: _Indices,
        driven_m: _Floats,
        position_sigma_m: _Floats,
        rotation_sigma_rad: _Floats,
        frustum_normals: _Floats,
        solid_angle_sr: _Floats,
    ) -> None: ...

_Noise = tuple[float, ...]
_Settings = tuple[float, float, float, float, int, int, float, list[str]]

_Calibration = tuple[
    _Noise, _Noise, bool, Sequence[Sequence[float] | None], Sequence[float], Sequence[Sequence[tuple[int, float]]]
]

def calibrate(
    scene: Scene,
    guess: _Noise,
    known: tuple[list[bool], float],
    settings: _Settings,
    is_part: bool,
    sought: _Noise | None,
    threads: int,
    progress: Callable[[int, int], None],
) -> tuple[_Calibration, _Floats, tuple[_Offsets, _Indices]]: ...
def misfits(
    scenes: tuple[Scene, Scene],
    second_of_first: NDArray[np.uint32],
    guess: _Noise,
    known: tuple[list[bool], float],
    settings: _Settings,
    threads: int,
    progress: Callable[[int, int], None],
) -> tuple[tuple[float, float], int, _Noise | None]: ...
def find_labels(
    scene: Scene, calibration: _Calibration, settings: _Settings, threads: int, progress: Callable[[int, int], None]
) -> tuple[_Floats, _Indices, tuple[_Offsets, _Indices], _Floats, _Floats, _Offsets, dict[str, float]]: ...
def camera_centers(cam_from_world_quat: _Floats, cam_from_world_m: _Floats, /) -> _Floats: ...
def revisits(
    place_m: _Floats,
    drive: NDArray[np.int64],
    driven_m: _Floats,
    near_m: _Floats,
    away_m: _Floats,
    ground: Sequence[int],
    /,
) -> NDArray[np.bool_]: ...
def viewpoint_openings(place_m: _Floats, begins: NDArray[np.bool_], step_m: float, /) -> NDArray[np.bool_]: ...
