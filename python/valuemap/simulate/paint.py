"""Painting one scene: from the sky forward to the nearest vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints
from valuemap.simulate.air import COARSE, Air
from valuemap.simulate.canvas import (
    ENLARGED,
    NEAR_M,
    Picture,
    View,
    bar_outlines_px,
    far_to_near,
    fill,
    on_canvas,
)
from valuemap.simulate.furniture import Bars, Signs, Trees
from valuemap.simulate.housings import LIT, lamp_px, paint_housing, paint_lookalike
from valuemap.simulate.paint_houses import paint_fronts
from valuemap.simulate.scene import Scene, World
from valuemap.simulate.streams import hash01, random_stream
from valuemap.simulate.vehicle_shapes import GLASS, HEAD_LAMP, PAINT, TAIL_LAMP, TRIM, TYRE
from valuemap.simulate.weather import Light, light_of_pass

_SIGHT_M = 150.0
_MARKS_M = 75.0
_FRONTS_M = 195.0
_THINGS_M = 110.0
_FAR = 10**6
_BAR, _SIGN, _TREE, _HOUSING, _VEHICLE = range(5)
_MATERIALS = {
    GLASS: (46, 54, 62),
    TYRE: (22, 22, 23),
    TRIM: (38, 39, 41),
    TAIL_LAMP: (120, 16, 16),
    HEAD_LAMP: (222, 222, 214),
}
_LEAVES = np.array([[92, 124, 66], [108, 130, 58], [78, 112, 72], [128, 122, 58]])
_LEAF_CORNERS = 18


@dataclass(eq=False)
class Painter:
    """Paints the images of one world; any number of threads may use it at a time."""

    world: World

    def __post_init__(self) -> None:
        scenery = self.world.scenery
        self._ground = cKDTree(scenery.ground.corner_in_world_m[:, :, :2].mean(axis=1))
        self._fronts = cKDTree((scenery.fronts.from_m + scenery.fronts.to_m) / 2.0)
        self._bars = cKDTree((scenery.bars.from_in_world_m[:, :2] + scenery.bars.to_in_world_m[:, :2]) / 2.0)
        self._trees = cKDTree(scenery.trees.foot_in_world_m[:, :2])
        self._signs = cKDTree(scenery.signs.center_in_world_m[:, :2])
        self._air = Air(self.world.recording.config, self.world.recording.seed)

    def paint(self, scene: Scene) -> Picture:
        """Return the picture of a scene."""
        view = scene.view
        light = light_of_pass(int(self.world.recording.frames.pass_row[scene.row]), seed=self.world.recording.seed)
        canvas = self._air.sky_behind(view, light)
        glow = np.zeros((-(-view.height_px // COARSE), -(-view.width_px // COARSE), 3), np.uint8)
        self._paint_ground(canvas, view, light)
        fronts = self.world.scenery.fronts.take(self._around(self._fronts, view, _FRONTS_M))
        paint_fronts(canvas, fronts, view, light, seed=self.world.recording.seed)
        self._paint_things(canvas, glow, scene, light)
        picture = cv2.resize(canvas, (view.width_px, view.height_px), interpolation=cv2.INTER_AREA)
        random = random_stream(self.world.recording.seed, "picture", scene.row)
        return self._air.expose(np.asarray(picture, np.uint8), glow, view, light, random)

    def _around(self, tree: cKDTree, view: View, radius_m: float) -> Ints:
        """Return the rows that are near the camera, in order."""
        ahead = view.cam_from_world[2, :2]
        ahead = ahead / np.linalg.norm(ahead)
        middle = view.center_in_world_m[:2] + 0.45 * radius_m * ahead
        return np.array(tree.query_ball_point(middle, 0.6 * radius_m, return_sorted=True), dtype=np.int64)

    def _paint_ground(self, canvas: Picture, view: View, light: Light) -> None:
        ground = self.world.scenery.ground
        rows = self._around(self._ground, view, _SIGHT_M)
        corners = ground.corner_in_world_m[rows]
        middle = corners.mean(axis=1)
        distance_m = np.linalg.norm(middle - view.center_in_world_m, axis=1)
        is_large = np.abs(corners[:, 2] - corners[:, 0]).max(axis=1) > 11.0
        near = is_large | (distance_m < _MARKS_M)
        rows, corners, distance_m = rows[near], corners[near], distance_m[near]
        color = light.through_haze(ground.color[rows] * light.on_ground, distance_m).tolist()
        for outline, shade in zip(view.outlines_px(corners), color, strict=True):
            if outline is not None:
                fill(canvas, outline, shade)

    def _paint_things(self, canvas: Picture, glow: Picture, scene: Scene, light: Light) -> None:
        """Paint poles, signs, lights and vehicles, the farthest first."""
        view, housings = scene.view, scene.housings
        bars, bar_px, bar_depth_m = self._bars_in(view)
        signs, sign_px, sign_depth_m = self._signs_in(view)
        trees, tree_px, tree_depth_m = self._trees_in(view)
        depth_m = [bar_depth_m, sign_depth_m, tree_depth_m, housings.depth_m, scene.vehicle_depth_m]
        kind = np.repeat(np.arange(_VEHICLE + 1), [len(d) for d in depth_m])
        index = np.concatenate([np.arange(len(d)) for d in depth_m])
        all_depth_m = np.concatenate(depth_m)
        metal = light.through_haze(bars.color * light.on_ground * 0.9, bar_depth_m).tolist()
        plate = light.through_haze(signs.color * light.on_walls(signs.normal), sign_depth_m).tolist()
        back = light.through_haze(np.full((len(signs), 3), 110.0) * light.on_ground, sign_depth_m).tolist()
        greens = _LEAVES[trees.number % len(_LEAVES)] * light.on_ground
        leaves = [
            light.through_haze(np.outer([0.62, 0.82, 1.05], green), np.full(3, far_m)).tolist()
            for green, far_m in zip(greens, tree_depth_m, strict=True)
        ]
        shows_front = ((view.center_in_world_m[:2] - signs.center_in_world_m[:, :2]) * signs.normal).sum(axis=1) > 0.0
        lamps = self.world.signals.lamps(
            self.world.recording.frames, scene.row, self.world.approach[housings.light_row]
        )
        face_color = self._vehicle_colors(scene, light)
        face_at = np.searchsorted(scene.faces.vehicle, np.arange(len(scene.vehicles) + 1))
        for job in far_to_near(all_depth_m):
            i = int(index[job])
            if kind[job] == _BAR:
                fill(canvas, bar_px[i], metal[i])
                if bars.is_street_lamp[i] and light.weather.lamps_are_on:
                    head = bar_px[i][1:3].mean(axis=0)
                    radius_px = max(0.7, 0.22 * view.focal_px / bar_depth_m[i])
                    _disc(canvas, head, radius_px, ENLARGED, (255, 226, 170))
                    _disc(glow, head, radius_px, 1.0 / COARSE, (255, 206, 140))
            elif kind[job] == _SIGN:
                fill(canvas, sign_px[i], plate[i] if shows_front[i] else back[i])
            elif kind[job] == _TREE:
                for blob, shade in zip(tree_px[i], leaves[i], strict=True):
                    fill(canvas, blob, shade)
            elif kind[job] == _HOUSING:
                self._paint_light(canvas, glow, scene, i, int(lamps[i]), light)
            else:
                for face in range(face_at[i], face_at[i + 1]):
                    outline = scene.outlines[face]
                    if outline is not None:
                        fill(canvas, outline, face_color[face])
                        self._glow_of_face(glow, outline, int(scene.faces.material[face]), light)

    def _paint_light(self, canvas: Picture, glow: Picture, scene: Scene, i: int, lamp: int, light: Light) -> None:
        housings, light_row = scene.housings, int(scene.housings.light_row[i])
        box_px, turn = housings.corners_px()[i], float(housings.cos_facing[i])
        clear = float(np.exp(-housings.depth_m[i] / light.weather.haze_length_m))
        if light_row >= self.world.light_count:
            paint_lookalike(canvas, box_px, light, clear)
            return
        i_approach, j_approach, _ = self.world.approach[light_row]
        paint_housing(canvas, box_px, turn, lamp, int(i_approach * 3 + j_approach), light, clear)
        if turn > 0.1:
            middle, radius_px = lamp_px(box_px, lamp)
            color = tuple(channel * (0.25 + 0.75 * turn) for channel in LIT[lamp])
            _disc(glow, middle, 1.3 * radius_px, 1.0 / COARSE, color)

    def _bars_in(self, view: View) -> tuple[Bars, Floats, Floats]:
        """Return poles in the picture, their outlines (N, 4, 2) and depths (N)."""
        bars = self.world.scenery.bars.take(self._around(self._bars, view, _THINGS_M))
        start, end = view.in_cam_m(bars.from_in_world_m), view.in_cam_m(bars.to_in_world_m)
        middle = (bars.from_in_world_m[:, :2] + bars.to_in_world_m[:, :2]) / 2.0
        seen = (np.minimum(start[:, 2], end[:, 2]) > NEAR_M) & ~self._is_round_corner(view, middle)
        bars, start, end = bars.take(seen), start[seen], end[seen]
        width_px = view.focal_px * bars.thickness_m[:, None] / np.stack([start[:, 2], end[:, 2]], axis=1)
        outline = bar_outlines_px(view.project_px(start), view.project_px(end), width_px)
        # Lights hang before their poles: what is in doubt is behind.
        return bars, outline, (start[:, 2] + end[:, 2]) / 2.0 + 0.15

    def _signs_in(self, view: View) -> tuple[Signs, list[Floats], Floats]:
        """Return signs in the picture, their outlines (K, 2) and depths (N)."""
        signs = self.world.scenery.signs.take(self._around(self._signs, view, _THINGS_M * 0.7))
        in_cam = view.in_cam_m(signs.center_in_world_m)
        seen = (in_cam[:, 2] > NEAR_M) & ~self._is_round_corner(view, signs.center_in_world_m[:, :2])
        signs, in_cam = signs.take(seen), in_cam[seen]
        middle_px = view.project_px(in_cam)
        radius_px = view.focal_px * signs.radius_m / in_cam[:, 2]
        toward = view.center_in_world_m[:2] - signs.center_in_world_m[:, :2]
        turn = np.abs((toward * signs.normal).sum(axis=1)) / np.linalg.norm(toward, axis=1)
        outlines = []
        for middle, radius, narrow, corners in zip(middle_px, radius_px, turn, signs.corners, strict=True):
            angle = (np.arange(corners) + 0.5) * (2.0 * np.pi / corners)
            circle = np.stack([narrow * np.cos(angle), np.sin(angle)], axis=1)
            outlines.append(middle + radius * circle)
        return signs, outlines, in_cam[:, 2]

    def _trees_in(self, view: View) -> tuple[Trees, Floats, Floats]:
        """Return trees in the picture, the outlines (N, 3, K, 2) of three layers of leaves and depths (N)."""
        trees = self.world.scenery.trees.take(self._around(self._trees, view, _THINGS_M))
        crown = trees.foot_in_world_m + trees.crown_m[:, None] * [0.0, 0.0, 1.0]
        in_cam = view.in_cam_m(crown)
        seen = (in_cam[:, 2] > 2.0) & ~self._is_round_corner(view, crown[:, :2])
        trees, in_cam = trees.take(seen), in_cam[seen]
        angle = np.arange(_LEAF_CORNERS) * (2.0 * np.pi / _LEAF_CORNERS)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        corner = np.arange(3 * _LEAF_CORNERS) + 100.0 * trees.number[:, None]
        bumpy = 0.72 + 0.45 * hash01(corner, self.world.recording.seed, 11).reshape(-1, 3, _LEAF_CORNERS)
        layer = np.array([[0.0, 0.0, 1.0], [-0.12, -0.16, 0.72], [-0.2, -0.34, 0.42]])
        unit = layer[:, None, :2] + layer[:, 2, None, None] * circle
        radius_px = view.focal_px * trees.radius_m / in_cam[:, 2]
        outline = view.project_px(in_cam)[:, None, None] + radius_px[:, None, None, None] * bumpy[..., None] * unit
        return trees, outline, in_cam[:, 2]

    def _is_round_corner(self, view: View, ground_m: Floats) -> Bools:
        own = np.broadcast_to(view.center_in_world_m[:2], ground_m.shape)
        return self.world.recording.city.streets.is_hidden_by_houses(own, ground_m)

    def _vehicle_colors(self, scene: Scene, light: Light) -> list[list[float]]:
        """Return the colour of each face of a vehicle."""
        faces = scene.faces
        color = np.empty((len(faces), 3))
        paint = scene.vehicles.color[faces.vehicle]
        lit = light.on_walls(faces.normal[:, :2]) + 0.6 * faces.normal[:, 2:] * np.asarray(light.weather.sunlight)
        ahead = scene.vehicles.ahead[faces.vehicle]
        # Even without sun the sides of a body differ.
        lit = lit * (0.88 + 0.12 * np.abs((faces.normal[:, :2] * ahead).sum(axis=1)))[:, None]
        color[:] = paint * lit
        for material, tone in _MATERIALS.items():
            color[faces.material == material] = np.asarray(tone) * light.on_ground
        sky = np.asarray(light.weather.sky_low) * 0.22
        color[faces.material == GLASS] += sky
        if light.weather.lamps_are_on:
            color[faces.material == TAIL_LAMP] = (230.0, 30.0, 24.0)
            color[faces.material == HEAD_LAMP] = (255.0, 250.0, 235.0)
        colors: list[list[float]] = light.through_haze(color, scene.vehicle_depth_m[faces.vehicle]).tolist()
        return colors

    def _glow_of_face(self, glow: Picture, outline: Floats, material: int, light: Light) -> None:
        if material in (TAIL_LAMP, HEAD_LAMP) and light.weather.lamps_are_on:
            radius_px = 0.5 * float(np.ptp(outline, axis=0).max())
            color = (255, 245, 225) if material == HEAD_LAMP else (190, 20, 14)
            _disc(glow, outline.mean(axis=0), radius_px, 1.0 / COARSE, color)
        elif material == PAINT:
            cv2.fillConvexPoly(glow, on_canvas(outline, 1.0 / COARSE), (0, 0, 0), cv2.LINE_8, 4)


def _disc(canvas: Picture, middle_px: Floats, radius_px: float, scale: float, color: tuple[float, ...]) -> None:
    """Paint a disc; one smaller than a pixel becomes a fainter pixel."""
    radius = radius_px * scale
    if radius < 0.5:
        color = tuple(channel * (2.0 * radius) ** 2 for channel in color)
        radius = 0.5
    x, y = (int(v) for v in on_canvas(middle_px, scale))
    if abs(x) < _FAR and abs(y) < _FAR:
        cv2.circle(canvas, (x, y), max(1, round(radius * 16.0)), color, -1, cv2.LINE_8, 4)
