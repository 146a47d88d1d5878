"""House fronts in a picture: walls, cornices, shops and windows."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, rows_in_runs
from valuemap.simulate.canvas import NEAR_M, Picture, View, far_to_near, fill, fill_all, inset
from valuemap.simulate.houses import Fronts
from valuemap.simulate.streams import hash01
from valuemap.simulate.weather import Light

_WINDOWS_M = 120.0
_FRAMES_M = 70.0
_BOARDS = np.array([[120, 40, 40], [40, 70, 60], [50, 56, 78], [150, 120, 70], [70, 66, 62], [170, 165, 155]])
_WINDOW_LIT = np.array([[255, 214, 140], [255, 232, 186], [236, 196, 120]])


def paint_fronts(canvas: Picture, fronts: Fronts, view: View, light: Light, *, seed: int) -> None:
    """Paint the fronts that face the camera, the farthest first.

    Where two overlap in the picture, a street of at least 24 m is between them, so that with houses of at most 21 m
    their middles tell which is nearer.
    """
    toward = view.center_in_world_m[:2] - fronts.from_m
    fronts = fronts.take((toward * fronts.normal).sum(axis=1) > 0.0)
    middle = (fronts.from_m + fronts.to_m) / 2.0
    distance_m = np.linalg.norm(middle - view.center_in_world_m[:2], axis=1)
    order = far_to_near(distance_m)
    fronts, distance_m = fronts.take(order), distance_m[order]
    corners = _upright(fronts.from_m, fronts.to_m, fronts.base_m, fronts.top_m)
    lit = light.on_walls(fronts.normal)
    wall = light.through_haze(fronts.color * lit, distance_m)
    trim = light.through_haze(fronts.color * lit * 0.72, distance_m)
    glass = np.asarray(light.weather.sky_low) * 0.3 * np.minimum(1.0, lit + 0.25) + [12.0, 15.0, 18.0]
    glass = light.through_haze(glass, distance_m)
    shine = light.through_haze(_WINDOW_LIT[fronts.number % len(_WINDOW_LIT)].astype(np.float64), 0.6 * distance_m)
    outlines = view.outlines_px(corners)
    is_seen = np.array([outline is not None for outline in outlines], dtype=np.bool_)
    band_of, bands = _bands(fronts, view, is_seen)
    frame = light.through_haze(np.clip(fronts.color * 1.22 + 16.0, 0.0, 250.0) * lit, distance_m)
    board = light.through_haze(_BOARDS[fronts.number % len(_BOARDS)] * lit, distance_m)
    window_of, number, windows = _windows(fronts, view, is_seen & (distance_m < _WINDOWS_M))
    bands, frames, windows = inset(bands), inset(_grown(windows)), inset(windows)
    is_lit = hash01(number + 1000 * fronts.number[window_of], seed, 7) < light.weather.lit_windows
    band_at = np.searchsorted(band_of, np.arange(len(fronts) + 1))
    window_at = np.searchsorted(window_of, np.arange(len(fronts) + 1))
    for row in np.flatnonzero(is_seen):
        outline = outlines[row]
        assert outline is not None
        fill(canvas, outline, wall[row].tolist())
        own = slice(band_at[row], band_at[row + 1])
        fill_all(canvas, bands[own][:2], trim[row].tolist())
        fill_all(canvas, bands[own][2:], board[row].tolist())
        own = slice(window_at[row], window_at[row + 1])
        if distance_m[row] < _FRAMES_M:
            fill_all(canvas, frames[own], frame[row].tolist())
        fill_all(canvas, windows[own][~is_lit[own]], glass[row].tolist())
        fill_all(canvas, windows[own][is_lit[own]], shine[row].tolist())


def _upright(start: Floats, stop: Floats, low: Floats, high: Floats) -> Floats:
    """Return upright rectangles (N, 4, 3) from points to points (N, 2) of the ground, between heights (N)."""
    feet = np.stack([start, stop, stop, start], axis=1)
    height = np.stack([low, low, high, high], axis=1)
    return np.concatenate([feet, height[:, :, None]], axis=2)


def _bands(fronts: Fronts, view: View, is_seen: Bools) -> tuple[Ints, Floats]:
    """Return plinth, cornice and board over the shops of each front: of which (3 N), and outlines (3 N, 4, 2)."""
    rows = np.flatnonzero(is_seen & (fronts.windows[:, 1] > 0))
    base, top = fronts.base_m[rows, None], fronts.top_m[rows, None]
    low = np.concatenate([base, top - 0.55, base + 3.15], axis=1).reshape(-1)
    high = np.concatenate([base + 0.9, top, base + 3.7], axis=1).reshape(-1)
    of = np.repeat(rows, 3)
    in_cam = view.in_cam_m(_upright(fronts.from_m[of], fronts.to_m[of], low, high))
    whole = np.all(in_cam[:, :, 2] > NEAR_M, axis=1).reshape(-1, 3).all(axis=1).repeat(3)
    return of[whole], view.project_px(in_cam[whole])


def _grown(outlines_px: Floats) -> Floats:
    """Return outlines (N, 4, 2) a little larger: the frames around windows."""
    middle = outlines_px.mean(axis=1, keepdims=True)
    grown: Floats = middle + (outlines_px - middle) * 1.16
    return grown


def _windows(fronts: Fronts, view: View, is_seen: Bools) -> tuple[Ints, Ints, Floats]:
    """Return windows: of which front (N), the number there, and outlines (N, 4, 2)."""
    rows = np.flatnonzero(is_seen)
    columns, storeys = fronts.windows[rows].T
    counts = columns * storeys
    of = np.repeat(np.arange(len(rows)), counts)
    number = rows_in_runs(0, counts)
    column, storey = number % columns[of], number // columns[of]
    # Shop windows below, and houses of different habits above.
    is_shop = storey == 0
    wide = 0.42 + 0.3 * hash01(fronts.number[rows], 3)
    half = np.where(is_shop, 0.41, wide[of] / 2.0)
    along = np.stack([(column + 0.5 - half), (column + 0.5 + half)], axis=1) / columns[of][:, None]
    of_front = rows[of]
    start, stop = fronts.from_m[of_front], fronts.to_m[of_front]
    low = fronts.base_m[of_front] + 0.3 + 3.3 * storey + np.where(is_shop, 0.6, 1.1)
    high = low + np.where(is_shop, 2.1, 1.6)
    corners = _upright(start + along[:, :1] * (stop - start), start + along[:, 1:] * (stop - start), low, high)
    in_cam = view.in_cam_m(corners)
    before = np.all(in_cam[..., 2] > NEAR_M, axis=1)
    return of_front[before], number[before], view.project_px(in_cam[before])
