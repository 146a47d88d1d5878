"""What is before the camera in one image: everything that moves and stands, and how much of each light is seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints
from valuemap.simulate.canvas import View
from valuemap.simulate.furniture import approach_of
from valuemap.simulate.housings import Housings, place_housings
from valuemap.simulate.rows import join_rows
from valuemap.simulate.scenery import Scenery, build_scenery
from valuemap.simulate.sightings import Sightings
from valuemap.simulate.signals import Signals, time_signals
from valuemap.simulate.simulation import Recording
from valuemap.simulate.targets import Targets
from valuemap.simulate.traffic import CAR, Vehicles, vehicles_around
from valuemap.simulate.vehicle_shapes import SHAPES
from valuemap.tables import Table

_LIGHTS_IN_SIGHT_M = 170.0
_SEEN_SHARE = 0.6
_HINT_SHARE = 0.1
_TRIES = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 5), np.linspace(-0.46, 0.46, 9)), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class World:
    """A recording with all that its pictures show."""

    recording: Recording
    scenery: Scenery
    signals: Signals
    targets: Targets
    approach: Ints
    first_sighting: Ints

    @cached_property
    def light_count(self) -> int:
        """How many of the targets are lights; the others are lookalikes."""
        return len(self.recording.city.lights)

    @cached_property
    def tree(self) -> cKDTree:
        """The targets on the ground."""
        return cKDTree(self.targets.position_in_world_m[:, :2])

    def sightings_in(self, row: int) -> tuple[Sightings, Bools]:
        """Return the sightings of lights in one image, and which of them traffic hides."""
        rows = np.arange(self.first_sighting[row], self.first_sighting[row + 1])
        return self.recording.sightings.take(rows), self.recording.is_hidden[rows]


@dataclass(frozen=True, eq=False)
class VehicleFaces(Table):
    """Faces of vehicles that the camera sees, in the order of painting within a vehicle."""

    vehicle: Ints
    corner_in_world_m: Floats
    material: Ints
    normal: Floats


@dataclass(frozen=True, eq=False)
class Scene:
    """What one camera has before it.

    `outlines` belong to `faces` (None if not in the picture); `vehicle_depth_m` is that of the nearest corner;
    `seen_share` (N) says how much of each housing nothing hides.
    """

    row: int
    view: View
    housings: Housings
    vehicles: Vehicles
    vehicle_depth_m: Floats
    faces: VehicleFaces
    outlines: list[Floats | None]
    seen_share: Floats


def build_world(recording: Recording) -> World:
    """Furnish the city of a recording, and time its signals.

    Raises
    ------
    SettingError
        Something in the city cannot be drawn.
    """
    recording.config.check_drawable()
    city, frames = recording.city, recording.frames
    targets = join_rows([city.lights, city.lookalikes])
    return World(
        recording=recording,
        scenery=build_scenery(city, seed=recording.seed),
        signals=time_signals(frames, city.streets, seed=recording.seed),
        targets=targets,
        approach=approach_of(targets, city.streets),
        first_sighting=np.searchsorted(recording.sightings.frame_row, np.arange(len(frames) + 1)),
    )


def look(world: World, row: int) -> Scene:
    """Return what the camera of one image has before it."""
    recording = world.recording
    frames, streets = recording.frames, recording.city.streets
    view = View.of_frame(frames, row, recording.config)
    own = view.center_in_world_m[:2]
    near = np.array(sorted(world.tree.query_ball_point(own, _LIGHTS_IN_SIGHT_M)), dtype=np.int64)
    housings = place_housings(world.targets, near, view)
    place = world.targets.position_in_world_m[housings.light_row, :2]
    housings = housings.take(~streets.is_hidden_by_houses(np.broadcast_to(own, place.shape), place))
    shown, hidden = world.sightings_in(row)
    lights = recording.city.lights.position_in_world_m
    vehicles = vehicles_around(frames, row, view, streets, lights, shown, hidden, seed=recording.seed)
    ground = vehicles.ground_in_world_m[:, :2]
    round_corner = streets.is_hidden_by_houses(np.broadcast_to(own, ground.shape), ground)
    # What stands before a light in view is in view, even if its middle is not.
    vehicles = vehicles.take((vehicles.kind != CAR) | ~round_corner)
    depth_m = view.in_cam_m(vehicles.corners_m())[..., 2].min(axis=1)
    faces = _faces(vehicles, view)
    outlines = view.outlines_px(faces.corner_in_world_m)
    return Scene(
        row=row,
        view=view,
        housings=housings,
        vehicles=vehicles,
        vehicle_depth_m=depth_m,
        faces=faces,
        outlines=outlines,
        seen_share=_seen_shares(housings, faces, outlines, depth_m),
    )


def true_boxes(world: World, scene: Scene) -> tuple[Floats, Floats]:
    """Return boxes (N, 4) and (K, 4) of lights: those that a detector should find, and those that it may.

    Boxes are centre x, y, width and height in pixels. It should find lights that the simulator counts as in view
    of which the picture shows most; it may find those of which less is to be seen.
    """
    housings = scene.housings
    shown, _ = world.sightings_in(scene.row)
    box = np.concatenate([housings.center_px, housings.size_px], axis=1)
    is_in_view = np.isin(housings.light_row, shown.target_row)
    should = is_in_view & (scene.seen_share >= _SEEN_SHARE)
    shows_front = (housings.light_row < world.light_count) & (housings.cos_facing > 0.0)
    may = ~should & shows_front & (scene.seen_share > _HINT_SHARE)
    return box[should], box[may]


def _faces(vehicles: Vehicles, view: View) -> VehicleFaces:
    parts = [_faces_of_kind(vehicles, np.flatnonzero(vehicles.kind == kind), kind, view) for kind in SHAPES]
    faces = join_rows(parts)
    return faces.take(np.argsort(faces.vehicle, kind="stable"))


def _faces_of_kind(vehicles: Vehicles, rows: Ints, kind: int, view: View) -> VehicleFaces:
    shape = SHAPES[kind]
    ahead = vehicles.ahead[rows]
    # World from vehicle: x ahead, y left, z up.
    turn = np.zeros((len(rows), 3, 3))
    turn[:, 0, 0], turn[:, 1, 0] = ahead[:, 0], ahead[:, 1]
    turn[:, 0, 1], turn[:, 1, 1] = -ahead[:, 1], ahead[:, 0]
    turn[:, 2, 2] = 1.0
    ground = vehicles.ground_in_world_m[rows]
    corner = np.einsum("vij,pkj->vpki", turn, shape.corner_m) + ground[:, None, None]
    normal = np.einsum("vij,pj->vpi", turn, shape.normal)
    seen = ((corner[:, :, 0] - view.center_in_world_m) * normal).sum(axis=2) < 0.0
    # The cabin of a car is above its body; else, of two parts, the farther is painted first.
    own = np.einsum("vji,vj->vi", turn, view.center_in_world_m - ground)[:, 0]
    part = np.broadcast_to(shape.part, seen.shape)
    order = np.where((own > 0.0)[:, None] | (kind == CAR), part, -part)
    vehicle, polygon = np.nonzero(seen)
    by_part = np.lexsort((polygon, order[vehicle, polygon], vehicle))
    vehicle, polygon = vehicle[by_part], polygon[by_part]
    return VehicleFaces(rows[vehicle], corner[vehicle, polygon], shape.material[polygon], normal[vehicle, polygon])


def _seen_shares(
    housings: Housings, faces: VehicleFaces, outlines: list[Floats | None], vehicle_depth_m: Floats
) -> Floats:
    """Return how much of each housing (N) neither vehicles nor nearer housings hide, at 45 points of each."""
    points = housings.center_px[:, None] + _TRIES * housings.size_px[:, None]
    hidden = np.zeros(points.shape[:2], dtype=np.bool_)
    for number, box in enumerate(housings.corners_px()):
        behind = housings.depth_m > housings.depth_m[number] + 0.05
        hidden[behind] |= np.all((points[behind] > box[:2]) & (points[behind] < box[2:]), axis=2)
    for vehicle, outline in zip(faces.vehicle, outlines, strict=True):
        behind = housings.depth_m > vehicle_depth_m[vehicle]
        if outline is not None and behind.any():
            hidden[behind] |= _is_inside(points[behind], outline)
    return 1.0 - hidden.mean(axis=1) if len(housings) else np.empty(0)


def _is_inside(points: Floats, outline: Floats) -> Bools:
    """Return which points (N, M, 2) are inside a convex outline (K, 2)."""
    side = np.roll(outline, -1, axis=0) - outline
    offset = points[:, :, None] - outline
    cross = side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]
    inside: Bools = np.all(cross >= 0.0, axis=2) | np.all(cross <= 0.0, axis=2)
    return inside
