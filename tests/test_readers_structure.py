"""Structure from motion: its process, what it keeps, how sure it is; and a street drawn here, found again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from reading import refusal, write
from test_readers_pictures import ANCHOR, picture, tags
from told import Told
from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.dataset import Dataset
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.readers import pictures as reader
from valuemap.readers.cameras_of import Camera
from valuemap.readers.pictures import read_pictures
from valuemap.readers.poses import LOOKING_NORTH
from valuemap.readers.structure import Picture, Posed, find_poses, mapping, process
from valuemap.readers.structure.adjust import Sights, _residuals, _slope_share, _weigh, adjust, gps_inflation
from valuemap.readers.structure.features import find_features, image_ids
from valuemap.readers.structure.job import Job, prepare, read_answer, read_job, write_answer
from valuemap.readers.structure.mapping import _triangulated, _Whole, confirmed, contradicts_gps
from valuemap.readers.structure.pairs import pairs_to_match

# How sure the poses are.


def drive_with_points(
    seed: int,
    *,
    gps_sigma_m: float = 1.0,
    pixel_sigma: float = 0.5,
    lasting: float = 0.0,
    turn_deg: float = 90.0,
) -> tuple[Sights, Floats, Floats]:
    """A camera that looks 4 degrees up drives round a corner; true rotations and centres, and what is seen of it.

    A share `lasting` of the error of a feature is what it was in the picture before.
    """
    random = np.random.default_rng(seed)
    count, width, height, focal = 40, 640, 480, 500.0
    corner = np.concatenate(
        [np.zeros(20), np.linspace(0.0, np.radians(turn_deg), 8), np.full(12, np.radians(turn_deg))]
    )
    ahead = np.stack([np.sin(corner), np.cos(corner), np.zeros(count)], axis=1)
    center = np.cumsum(2.0 * ahead, axis=0) + [0.0, 0.0, 1.6]
    look = Rotation.from_euler("zx", np.stack([-corner, np.full(count, np.radians(4.0))], axis=1)).as_matrix()
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ np.swapaxes(look, 1, 2)
    points = np.array([-30.0, -20.0, 0.0]) + random.random((700, 3)) * [100.0, 110.0, 15.0]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=[focal, 320.0, 240.0, 0.0])
    image, point, pixel = [], [], []
    error = random.normal(0.0, pixel_sigma, (len(points), 2))
    for i in range(count):
        error = lasting * error + np.sqrt(1.0 - lasting**2) * random.normal(0.0, pixel_sigma, error.shape)
        in_cam = (points - center[i]) @ rotation[i].T
        px = focal * in_cam[:, :2] / in_cam[:, 2:] + [320.0, 240.0]
        seen = (in_cam[:, 2] > 2.0) & (in_cam[:, 2] < 40.0) & np.all((px > 0) & (px < [640.0, 480.0]), axis=1)
        rows = np.flatnonzero(seen)
        image += [i] * len(rows)
        point += rows.tolist()
        pixel.append(px[rows] + error[rows])
    of = np.array(point)
    kept = (np.bincount(of, minlength=700) > 1)[of]
    which, of = np.unique(of[kept], return_inverse=True)
    shaken = Rotation.from_rotvec(random.normal(0.0, 0.002, (count, 3))).as_matrix() @ rotation
    sights = Sights(
        row=np.arange(count),
        cam_from_world=shaken,
        center_in_world_m=center + random.normal(0.0, 0.1, center.shape),
        camera_id=np.ones(count, dtype=np.int64),
        cameras={1: camera},
        has_focal={1: True},
        gps_in_world_m=center + random.normal(0.0, gps_sigma_m, center.shape) * [1.0, 1.0, 2.0],
        sigma_m=np.full(count, gps_sigma_m),
        drive=np.zeros(count, dtype=np.int64),
        image=np.array(image)[kept],
        point=of,
        pixel=np.concatenate(pixel)[kept],
        point_in_world_m=points[which] + random.normal(0.0, 0.2, (len(which), 3)),
    )
    return sights, rotation, center


def after_moving_the_whole(center: Floats, true: Floats) -> Floats:
    turn, _ = Rotation.align_vectors(true - true.mean(axis=0), center - center.mean(axis=0))
    moved = turn.apply(center - center.mean(axis=0))
    scale = (moved * (true - true.mean(axis=0))).sum() / (moved**2).sum()
    return np.asarray(scale * moved - (true - true.mean(axis=0)))


def test_errors_are_as_large_as_their_sigmas_say() -> None:
    """In the world, where the GPS counts, and within the part, where features do: 40 pictures of three drives."""
    world, within, turned = [], [], []
    for seed in range(3):
        sights, rotation, center = drive_with_points(seed)
        found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64))
        error = found.center_in_world_m - center
        world.append((error**2).sum() / (3.0 * (found.sigma[:, 0] ** 2).sum()))
        rest = after_moving_the_whole(found.center_in_world_m, center)
        within.append((rest**2).sum() / (3.0 * (found.sigma_in_part[:, 0] ** 2).sum()))
        angle = Rotation.from_matrix(found.cam_from_world @ np.swapaxes(rotation, 1, 2)).magnitude()
        turned.append((angle**2).sum() / (3.0 * (found.sigma[:, 1] ** 2).sum()))
        assert np.linalg.norm(rest, axis=1).max() < 0.4
        assert np.median(found.sigma_in_part[:, 0]) < 0.05 < 0.1 < found.sigma[:, 0].min()
        assert abs(found.cameras[1].params[0] - 500.0) < 5.0
    for ratio in (world, within, turned):
        assert 0.4 < np.sqrt(np.mean(ratio)) < 1.6


def test_errors_of_features_that_last_are_not_taken_for_none() -> None:
    """Points follow them, so that residuals halve; what points pull poses does not."""
    sigma = []
    for lasting in (0.0, 0.95):
        sights, _, _ = drive_with_points(0, lasting=lasting)
        found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64))
        sigma.append(float(np.median(found.sigma_in_part[:, 0])))
    assert sigma[1] > 0.75 * sigma[0]


def test_a_corner_that_features_bend_is_straightened_by_the_gps(monkeypatch: pytest.MonkeyPatch) -> None:
    """By all features the corner has 94 degrees, by the GPS 90: what features weigh in all is learned from that."""
    sights, _, bent = drive_with_points(0, gps_sigma_m=0.5, turn_deg=94.0)
    _, _, center = drive_with_points(0)
    sights = replace(sights, gps_in_world_m=sights.gps_in_world_m - bent + center)
    one_part = np.zeros(len(sights.row), dtype=np.int64)
    rest = after_moving_the_whole(adjust(sights, one_part).center_in_world_m, center)
    assert np.sqrt((rest**2).sum(axis=1).mean()) < 0.15
    monkeypatch.setattr("valuemap.readers.structure.adjust._growth_of_features", lambda *_: 1.0)
    rest = after_moving_the_whole(adjust(sights, one_part).center_in_world_m, center)
    assert np.sqrt((rest**2).sum(axis=1).mean()) > 0.3


def test_points_that_slide_bend_less_in_the_last_adjustment() -> None:
    """Where two edges cross that are not of one thing, a point slides: here one in five, by a pixel a picture."""

    def error_m(seed: int, *, is_last: bool) -> float:
        sights, _, center = drive_with_points(seed, pixel_sigma=0.3)
        slides = np.random.default_rng(seed).random(len(sights.point_in_world_m)) < 0.2
        first = np.full(len(slides), len(sights.row))
        np.minimum.at(first, sights.point, sights.image)
        sights.pixel[:, 0] += slides[sights.point] * (sights.image - first[sights.point])
        found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64), is_last=is_last)
        rest = after_moving_the_whole(found.center_in_world_m, center)
        return float(np.sqrt((rest**2).sum(axis=1).mean()))

    last, before = (np.mean([error_m(seed, is_last=is_last) for seed in range(4)]) for is_last in (True, False))
    assert last < 0.75 * before


@pytest.mark.parametrize("power", [1, 2])
def test_how_much_pulls_change_with_errors_is_their_slope(power: int) -> None:
    sights, _, _ = drive_with_points(0, pixel_sigma=2.0)
    weights = _weigh(sights, np.ones(len(sights.row)), 1.0, power)
    error = _residuals(sights)

    def pull(moved: Floats) -> Floats:
        square = (moved**2).sum(axis=1, keepdims=True) / (2.5 * weights.sigma_px) ** 2
        return np.asarray(moved / (1.0 + square) ** power)

    steps = np.eye(2) * 1e-5
    slope = sum((pull(error + step) - pull(error - step)) @ step / 2e-10 for step in steps) / 2.0
    share = np.nansum(slope) / np.nansum(np.linalg.norm(pull(error), axis=1) / np.linalg.norm(error, axis=1))
    assert _slope_share(sights, weights) == pytest.approx(share, rel=1e-4)


def test_only_the_last_of_the_rounds_takes_the_loss_of_settled_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where points are made anew from bent poses, a loss that lets go of the others would hold the bend."""
    asked = []

    def settle(*_: Any, is_last: bool) -> tuple[None, None, None]:
        asked.append(is_last)
        return None, None, None

    monkeypatch.setattr(mapping, "_triangulated", lambda *_: None)
    monkeypatch.setattr(mapping, "_with_the_rest", lambda *_: None)
    monkeypatch.setattr(mapping, "_settle", settle)
    mapping._unite(Job([], [], []), Path(), {}, _Whole(), {}, 1, Told())
    assert asked == [False, False, True]


def test_a_gps_that_wanders_does_not_bend_what_features_know() -> None:
    sights, _, center = drive_with_points(1)
    random = np.random.default_rng(4)
    off = random.normal(0.0, 1.0, center.shape)
    for i in range(1, len(off)):
        off[i] = 0.9 * off[i - 1] + np.sqrt(1.0 - 0.9**2) * off[i]
    sights = replace(sights, gps_in_world_m=center + off * [1.0, 1.0, 2.0])
    found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64))
    rest = after_moving_the_whole(found.center_in_world_m, center)
    assert np.sqrt((rest**2).sum(axis=1).mean()) < 0.15


def test_an_outlier_of_the_gps_moves_nothing() -> None:
    sights, _, center = drive_with_points(0)
    sights.gps_in_world_m[11] += [60.0, 0.0, 0.0]
    sights.gps_in_world_m[30] = np.nan
    found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64))
    assert np.linalg.norm(found.center_in_world_m - center, axis=1).max() < 2.5
    assert contradicts_gps(found.center_in_world_m, sights.gps_in_world_m, sights.sigma_m).nonzero()[0].tolist() == [11]


def test_what_is_wrong_yet_is_not_taken_for_errors_of_the_gps(monkeypatch: pytest.MonkeyPatch) -> None:
    """From half the scale on half the way: how alike residuals are is asked of poses that agree with the GPS."""
    sights, _, center = drive_with_points(1, gps_sigma_m=0.3)
    pivot, asked = center[21], []
    early = np.unique(sights.point[sights.image < 22])
    sights.point_in_world_m[early] = pivot + 0.5 * (sights.point_in_world_m[early] - pivot)
    sights.center_in_world_m[:22] = pivot + 0.5 * (sights.center_in_world_m[:22] - pivot)

    def ask(off: Floats, drive: Ints) -> Floats:
        asked.append(np.abs(off).max())
        return gps_inflation(off, drive)

    monkeypatch.setattr("valuemap.readers.structure.adjust.gps_inflation", ask)
    found = adjust(sights, np.zeros(len(sights.row), dtype=np.int64))
    assert max(asked) < 5.0
    assert np.linalg.norm(found.center_in_world_m - center, axis=1).max() < 0.6


def test_gps_errors_that_follow_each_other_count_for_less() -> None:
    random = np.random.default_rng(0)
    white = random.normal(0.0, 1.0, (400, 3))
    walk = white.copy()
    for i in range(1, len(walk)):
        walk[i] = 0.9 * walk[i - 1] + np.sqrt(1.0 - 0.9**2) * white[i]
    one = np.zeros(400, dtype=np.int64)
    assert gps_inflation(white, one).max() < 1.4
    # Its sum of autocorrelations is 9: the square root of 19.
    assert 3.0 < gps_inflation(walk, one).min() < 6.0
    assert_allclose(gps_inflation(walk[:10], one[:10]), 1.0)
    assert gps_inflation(3.0 * white, one).min() > 2.5


def test_what_only_two_pictures_see_counts_where_they_share_little_else() -> None:
    """Pictures 0 to 2 share 60 points, and 0 and 1 one of their own; 2 and 3 share ten that no third confirms."""
    image = np.concatenate([np.tile([0, 1, 2], 60), [0, 1], np.tile([2, 3], 10), [3]])
    point = np.concatenate([np.repeat(np.arange(60), 3), [60, 60], np.repeat(np.arange(61, 71), 2), [71]])
    assert confirmed(image, point).tolist() == [True] * 180 + [False] * 2 + [True] * 20 + [False]


def test_what_two_pictures_alone_see_far_away_is_kept(tmp_path: Path) -> None:
    """At a corner little else says how a camera turned: 60 points 150 m away, 0.4 to 1 degree between their sights."""
    random, centers = np.random.default_rng(0), [np.zeros(3), np.array([1.2, 0.0, 0.0]), np.array([2.5, 0.0, 0.0])]
    points = np.array([-40.0, -30.0, 150.0]) + random.random((60, 3)) * [80.0, 60.0, 20.0]
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.0))
    rows = [Picture(f"{i}.jpg", picture(tmp_path / f"{i}.jpg"), 0, each, 1.0, "a") for i, each in enumerate(centers)]
    job, work = Job(rows, [camera], [True]), tmp_path / "work"
    prepare(work, job)
    find_features(job, work, threads=1, progress=lambda *_: None)
    with pycolmap.Database.open(work / "database.db") as database:
        database.clear_keypoints()
        for i, center in enumerate(centers):
            seen = points - center
            pixels = 500.0 * seen[:, :2] / seen[:, 2:] + [320.0, 240.0]
            database.write_keypoints(i + 1, np.asarray(pixels, dtype=np.float32))
        for one, two, which in ((1, 2, np.arange(30)), (2, 3, np.arange(30, 60))):
            matches = np.stack([which, which], axis=1).astype(np.uint32)
            database.write_matches(one, two, matches)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, matches
            database.write_two_view_geometry(one, two, geometry)
        cameras = {each.camera_id: each for each in database.read_all_cameras()}
    whole = _Whole({i: (np.eye(3), each) for i, each in enumerate(centers)}, cameras)
    model = _triangulated(job, work, {0: 1, 1: 2, 2: 3}, whole, 4.0, 1)
    assert model.num_points3D() == 60


# Features.


def test_pictures_have_the_same_numbers_whoever_is_done_first(tmp_path: Path) -> None:
    """Two threads: the first picture is full of features, the others are blank; the third is no picture."""
    random, rows = np.random.default_rng(0), []
    for i in range(5):
        path = tmp_path / "photos" / f"{i}.jpg"
        path.parent.mkdir(exist_ok=True)
        pixels = texture(random, 400, 300) if i == 0 else np.zeros((300, 400), np.uint8)
        path.write_bytes(b"no picture") if i == 2 else Image.fromarray(pixels).save(path)
        rows.append(Picture(path.name, path, 0, np.array([10.0 * i, 0.0, 0.0]), 1.0, "a"))
    job = Job(rows, [Camera("SIMPLE_RADIAL", 400, 300, (400.0, 200.0, 150.0, 0.0))], [True])
    prepare(tmp_path / "work", job)
    find_features(job, tmp_path / "work", threads=2, progress=lambda *_: None)
    assert image_ids(job, tmp_path / "work") == {0: 1, 1: 2, 3: 4, 4: 5}
    with pycolmap.Database.open(tmp_path / "work" / "database.db") as database:
        assert [(i.image_id, i.name) for i in database.read_all_images()] == [(i + 1, job.alias(i)) for i in range(5)]
        assert [prior.position[0] for prior in database.read_all_pose_priors()] == [0.0, 10.0, 30.0, 40.0]


# What is matched.


def make_job(folder: Path, places: Any, drives: list[str]) -> Job:
    rows = []
    for i, (place, drive) in enumerate(zip(places, drives, strict=True)):
        path = picture(folder / f"{i}.jpg")
        rows.append(Picture(path.name, path, 0, np.array([*place, 0.0], dtype=np.float64), 3.0, drive))
    return Job(rows, [Camera("SIMPLE_RADIAL", 64, 48, (60.0, 32.0, 24.0, 0.0))], [True])


def test_pictures_are_matched_along_the_drive_and_with_others_near(tmp_path: Path) -> None:
    places = [(10.0 * i, 0.0) for i in range(30)] + [(101.0, 3.0), (np.nan, np.nan)]
    pairs = pairs_to_match(make_job(tmp_path, places, ["a"] * 30 + ["b", "b"]))
    assert {(0, 1), (0, 12), (5, 9)} <= set(pairs)
    assert not {(0, 7), (0, 13), (0, 20)} & set(pairs)
    assert {(8, 30), (10, 30), (12, 30), (30, 31)} <= set(pairs)
    assert (5, 30) not in pairs
    assert all(a < b for a, b in pairs)


# The process.


def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    """Let another program do the work."""
    source = f"import json, os, signal, sys, time\nfrom pathlib import Path\n{textwrap.dedent(body)}"
    write(tmp_path / "programs" / "stand_in.py", source)
    monkeypatch.setattr(process, "CHILD", "stand_in")
    monkeypatch.syspath_prepend(tmp_path / "programs")


def run(job: Job, workspace: Path, **options: Any) -> Posed:
    return find_poses(job.pictures, job.cameras, job.has_focal, workspace, **options)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "crashed (SIGSEGV)"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "is there enough memory?"),
        ("sys.exit('ModuleNotFoundError: no pycolmap')", "failed: ModuleNotFoundError: no pycolmap"),
        ("print(json.dumps(['error', 'no model', 'take more']))", "no model | take more"),
        ("", "ended without an answer"),
    ],
)
def test_a_process_that_fails_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, expected: str
) -> None:
    stand_in(tmp_path, monkeypatch, body)
    job = make_job(tmp_path / "photos", [(0, 0), (1, 0)], ["a", "a"])
    assert expected in refusal(lambda: run(job, tmp_path / "work"))


def is_alive(number: int) -> bool:
    return Path(f"/proc/{number}").exists() and "Z" not in Path(f"/proc/{number}/stat").read_text().rsplit(")")[1][:3]


def test_whoever_stops_us_stops_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "print(json.dumps(['progress', 'x', os.getpid(), 9]), flush=True); time.sleep(60)")
    job = make_job(tmp_path / "photos", [(0, 0), (1, 0)], ["a", "a"])
    told: list[int] = []

    def stop(what: str, done: int, total: int) -> None:
        told.append(done)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(job, tmp_path / "work", progress=stop)
    assert not is_alive(told[0])


def test_the_process_ends_when_we_do(tmp_path: Path) -> None:
    job = make_job(tmp_path / "photos", [(0, 0), (1, 0)], ["a", "a"])
    prepare(tmp_path / "work", job)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    name = "valuemap.readers.structure.child"
    code = f"import time, {name} as child; child.work = lambda *_: time.sleep(60); child.main()"
    child = subprocess.Popen([sys.executable, "-c", code, "work", "1"], stdin=subprocess.PIPE, env=environment)
    assert child.stdin is not None
    child.stdin.close()
    assert child.wait() == 1
    assert child.returncode != -signal.SIGKILL


def an_answer() -> Posed:
    return Posed(
        row=np.array([0]),
        world_from_cam=LOOKING_NORTH[None],
        center_in_world_m=np.zeros((1, 3)),
        position_sigma_m=np.array([0.1]),
        rotation_sigma_rad=np.array([0.01]),
        part=np.array([0]),
        on_earth_m=0.5,
        cameras={0: Camera("SIMPLE_RADIAL", 64, 48, (61.0, 32.0, 24.0, 0.1))},
        why_not={1: "too little of it is seen in other pictures"},
    )


def test_what_was_found_is_kept_for_the_same_pictures_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "sys.exit('works anew')")
    job, work = make_job(tmp_path / "photos", [(0, 0), (1, 0)], ["a", "a"]), tmp_path / "work"
    prepare(work, job)
    assert [each.name for each in read_job(work).pictures] == ["0.jpg", "1.jpg"]
    assert read_answer(work) is None
    write_answer(work, an_answer())
    found = run(job, work)
    assert found.cameras == an_answer().cameras
    assert found.why_not == an_answer().why_not
    picture(tmp_path / "photos" / "1.jpg", size=(64, 40))
    assert "works anew" in refusal(lambda: run(job, work))
    assert read_answer(work) is None


def test_a_workspace_of_somebody_else_stays(tmp_path: Path) -> None:
    job = make_job(tmp_path / "photos", [(0, 0), (1, 0)], ["a", "a"])
    write(tmp_path / "mine" / "notes.txt", "mine")
    assert "is not empty and not ours" in refusal(lambda: run(job, tmp_path / "mine"))
    assert "is a file" in refusal(lambda: run(job, tmp_path / "mine" / "notes.txt"))
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


# Pictures without a pose.


def test_pictures_without_anything_in_common_are_told_as_such(tmp_path: Path) -> None:
    """White walls have no features."""
    for i in range(4):
        picture(tmp_path / "photos" / f"{i}.jpg", tags(52.0, 4.0 + i * 1e-4, FocalLengthIn35mmFilm=36))
    said = refusal(lambda: read_pictures(tmp_path / "photos", workspace=tmp_path / "work"))
    assert "no two of 4 pictures that have anything in common | do neighbouring pictures overlap" in said


def test_pictures_without_a_pose_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of them, which stops no import; boxes on them are left out with them."""
    for i in range(2):
        picture(tmp_path / "photos" / f"{i}.jpg", tags(52.0, 4.0 + i * 1e-4, FocalLengthIn35mmFilm=36))
    boxes = "image,x1,y1,x2,y2,class\n0.jpg,1,1,9,9,light\n1.jpg,1,1,9,9,light\n"
    monkeypatch.setattr(reader, "find_poses", lambda *_, **__: an_answer())
    told: list[str] = []
    dataset = read_pictures(
        tmp_path / "photos",
        workspace=tmp_path / "work",
        detections=write(tmp_path / "boxes.csv", boxes),
        tell=told.append,
    )
    assert dataset.images.name.to_pylist() == ["0.jpg"]
    assert len(dataset.detections) == 1
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == ["1.jpg", "1.jpg"]
    assert dataset.rejected.reason.texts()[0] == an_answer().why_not[1]
    assert "found the poses of 1 of 2 pictures" in told[0]
    assert "0.50 m" in told[1]


# A street that is drawn here.

WIDTH, HEIGHT, FOCAL = 400, 300, 340.0


def texture(random: np.random.Generator, width: int, height: int) -> Any:
    """Spots of many sizes: something for features at every distance."""
    total = np.zeros((height, width), np.float32)
    for cell in (4, 8, 16, 32):
        small = random.random((height // cell + 1, width // cell + 1)).astype(np.float32)
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return ((total - total.min()) / np.ptp(total) * 255).astype(np.uint8)


def street(random: np.random.Generator) -> list[tuple[Floats, Any]]:
    """Walls as corners (4, 3) in the world with their textures: left and right in pieces, a far end, and the ground."""
    walls = []
    for side in (-7.0, 7.0):
        for start in range(0, 60, 12):
            x = side + random.uniform(-1.0, 1.0)
            corners = [[x, start, 8], [x, start + 10, 8], [x, start + 10, 0], [x, start, 0]]
            walls.append((np.array(corners, dtype=np.float64), texture(random, 500, 400)))
    end = [[-12, 62, 10], [12, 62, 10], [12, 62, 0], [-12, 62, 0]]
    return [(np.array(end, dtype=np.float64), texture(random, 600, 300)), *walls]


def draw(walls: list[tuple[Floats, Any]], cam_from_world: Floats, center: Floats) -> Any:
    """The walls from far to near, each by the homography of its piece in front of the camera."""
    canvas = np.full((HEIGHT, WIDTH), 200, np.uint8)
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    for corners, image in sorted(walls, key=lambda wall: -np.linalg.norm(wall[0].mean(axis=0) - center)):
        height, width = image.shape
        # From the picture's pixels into the plane of the wall, and on into the view.
        right, down = (corners[1] - corners[0]) / width, (corners[3] - corners[0]) / height
        view = k @ cam_from_world @ np.column_stack([right, down, corners[0] - center])
        depth = (cam_from_world @ (corners - center).T)[2]
        if depth.max() < 0.5:
            continue
        inverse = np.linalg.inv(view)
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        x, y, w = np.einsum("ij,jhw->ihw", inverse, np.stack([u, v, np.ones_like(u)]))
        w = np.where(np.abs(w) < 1e-9, 1e-9, w)
        column, row = x / w, y / w
        inside = (column > 0) & (column < width) & (row > 0) & (row < height)
        # In front where the depth of the point, 1 / w up to a factor, is positive.
        inside &= 1.0 / w > 0.3
        sampled = cv2.remap(
            image,
            (column - 0.5).astype(np.float32),
            (row - 0.5).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        canvas[inside] = sampled[inside]
    return canvas


def drive(folder: Path, count: int = 9) -> tuple[Floats, Floats]:
    """Draw a drive along the street, with GPS of 0.1 m noise; return centres and rotations, cam from world."""
    random = np.random.default_rng(1)
    walls, centers, rotations = street(random), [], []
    for i in range(count):
        center = np.array([0.8 * np.sin(0.4 * i), 2.0 * i, 1.6 + 0.1 * np.cos(i)])
        turn = Rotation.from_euler("zx", [0.08 * np.sin(0.7 * i), 0.02 * np.cos(i)]).as_matrix()
        rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ turn
        lon, lat, height = lon_lat_height_from_enu((center + random.normal(0.0, 0.1, 3))[None], ANCHOR)[0].tolist()
        exif = tags(
            lat, lon, height, FocalLengthIn35mmFilm=29, GPSDateStamp="2023:11:14", GPSTimeStamp=(22.0, 13.0, float(i))
        )
        folder.mkdir(exist_ok=True)
        # Names say nothing of the order.
        pixels = np.repeat(draw(walls, rotation, center)[:, :, None], 3, axis=2)
        Image.fromarray(pixels).save(folder / f"{(i * 5) % count:02d} x.jpg", exif=exif, quality=95)
        centers.append(center)
        rotations.append(rotation)
    return np.array(centers), np.array(rotations)


@pytest.fixture(scope="module")
def found_street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dataset, Floats, Floats, list[str]]:
    """A drive of nine pictures and what is found of it: folder, dataset, true centres and rotations, and progress."""
    folder = tmp_path_factory.mktemp("street")
    centers, rotations = drive(folder / "pictures")
    told = Told()
    dataset = read_pictures(
        folder / "pictures",
        workspace=folder / "work",
        anchor=ANCHOR,
        gps_sigma_m=0.1,
        threads=2,
        progress=told,
    )
    told.check("finding features", "matching pictures", "finding poses", "adjusting poses")
    return folder, dataset, centers, rotations, [what for what, _, _ in told.calls]


Street = tuple[Path, Dataset, Floats, Floats, list[str]]


def test_structure_from_motion_finds_poses(found_street: Street) -> None:
    _, dataset, centers, rotations, steps = found_street
    assert len(dataset.images) == len(centers)
    assert {"finding features", "matching pictures", "finding poses", "adjusting poses"} <= set(steps)
    assert dataset.images.timestamp_s is not None
    row = (dataset.images.timestamp_s - dataset.images.timestamp_s.min()).round().astype(int)
    error = camera_centers(dataset.images) - centers[row]
    relative = np.linalg.norm(error[:, None] - error[None], axis=2)
    assert relative.max() < 0.3
    turned = np.einsum("nij,nij->n", rotation_matrices(dataset.images), rotations[row])
    assert np.degrees(np.arccos(np.clip((turned - 1.0) / 2.0, -1.0, 1.0))).max() < 2.0
    assert dataset.images.position_sigma_m is not None
    assert 0.0 < np.median(dataset.images.position_sigma_m) < 0.1
    assert_allclose(dataset.cameras.params[0][0], FOCAL, rtol=0.03)


def test_it_goes_on_where_it_was(found_street: Street, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, dataset, _, _, _ = found_street

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("this was done before")

    # The last step is not there. Without the pictures, neither features nor matches can be found again.
    (folder / "work" / "poses.npz").unlink()
    for link in sorted((folder / "work" / "pictures").iterdir()):
        link.unlink()
    options: Any = {"workspace": folder / "work", "anchor": ANCHOR, "gps_sigma_m": 0.1, "threads": 2}
    again = read_pictures(folder / "pictures", **options)
    assert_allclose(again.images.cam_from_world_m, dataset.images.cam_from_world_m, atol=1e-6)
    monkeypatch.setattr(subprocess, "Popen", never)
    once_more = read_pictures(folder / "pictures", **options)
    assert_allclose(once_more.images.cam_from_world_m, again.images.cam_from_world_m, atol=0)
