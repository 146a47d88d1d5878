"""Rays of every camera model of COLMAP: through the point they show, and with the camera's own reprojection error."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from block import SHORT_STREETS, block
from camera_models import cameras_like, distances_m, measure, seen_through
from small_dataset import small_dataset
from valuemap.arrays import Floats
from valuemap.camera_models import Pinhole, camera_models, names_of_params, places_of_params
from valuemap.cameras import (
    Rays,
    camera_centers,
    camera_poses,
    cast_rays,
    colmap_camera,
    directions_down,
    lens_of,
    rotation_matrices,
)
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, Frame
from valuemap.pipeline import build_map
from valuemap.simulate import PRESETS, simulate
from valuemap.tables import Cameras, Categories, Detections, Images

WIDTH, HEIGHT = 800, 600
PARAMS: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [520, 402, 297],
    "PINHOLE": [520, 505, 402, 297],
    "SIMPLE_RADIAL": [520, 402, 297, -0.08],
    "RADIAL": [520, 402, 297, -0.08, 0.02],
    "OPENCV": [520, 505, 402, 297, -0.08, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [520, 505, 402, 297, -0.08, 0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
    "FOV": [420, 410, 402, 297, 0.9],
    "SIMPLE_DIVISION": [520, 402, 297, -0.1],
    "DIVISION": [520, 505, 402, 297, -0.1],
    "EUCM": [420, 410, 402, 297, 0.5, 1.1],
    "SIMPLE_FISHEYE": [330, 402, 297],
    "FISHEYE": [330, 320, 402, 297],
    "SIMPLE_RADIAL_FISHEYE": [330, 402, 297, -0.02],
    "RADIAL_FISHEYE": [330, 402, 297, -0.02, 0.004],
    "OPENCV_FISHEYE": [330, 320, 402, 297, -0.02, 0.004, 0.001, -0.0005],
    "THIN_PRISM_FISHEYE": [330, 320, 402, 297, -0.02, 0.004, 0.001, -0.0005, 0.001, 0.0002, 0.001, -0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(330, 320, 402, 297, -0.02, 0.004, 0.001, -0.0005),
        *(0.0002, 0.0001, 0.001, -0.001, 0.0005, -0.0005, 0.0004, 0.0001),
    ],
    "EQUIRECTANGULAR": [WIDTH, HEIGHT],
}
WITHOUT_DISTORTION = ("SIMPLE_PINHOLE", "PINHOLE")


def dataset_of(model: str, params: list[float], center_px: Floats, *, seed: int = 3) -> Dataset:
    """Return a dataset with one detection an image, each image with a pose of its own."""
    count = len(center_px)
    ids = np.arange(count)
    random = np.random.default_rng(seed)
    return Dataset(
        name="rays",
        frame=Frame(),
        cameras=Cameras(
            camera_id=np.array([4]),
            model=Categories.from_texts([model]),
            width_px=np.array([WIDTH]),
            height_px=np.array([HEIGHT]),
            params=[np.array(params, dtype=np.float64)],
        ),
        images=Images(
            image_id=ids,
            name=pa.array([f"{i}.jpg" for i in ids]),
            camera_id=np.full(count, 4),
            cam_from_world_quat=Rotation.random(count, rng=random).as_quat(scalar_first=True),
            cam_from_world_m=random.normal(0.0, 30.0, (count, 3)),
            pass_id=Categories.from_texts(["p"] * count),
        ),
        detections=Detections(
            detection_id=ids,
            image_id=ids,
            class_name=Categories.from_texts(["light"] * count),
            center_px=center_px,
            size_px=np.full((count, 2), 10.0),
            score=np.ones(count),
        ),
    )


def visible_points(camera: pycolmap.Camera, count: int = 300) -> tuple[Floats, Floats]:
    """Return random points (N, 3) in camera axes that the camera sees, and their pixels (N, 2)."""
    random = np.random.default_rng(1)
    direction = random.normal(0.0, 1.0, (20 * count, 3))
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * random.uniform(3, 80, (20 * count, 1))
    if not camera.is_spherical():  # Farther out radial distortion folds back, and two points share a pixel.
        widest = 0.55 if camera.is_perspective_pinhole() else 0.1
        points = points[points[:, 2] > widest * np.linalg.norm(points, axis=1)]
    pixels = np.asarray(camera.img_from_cam(points))
    inside = np.all((pixels >= 0.0) & (pixels <= [WIDTH, HEIGHT]), axis=1)
    assert inside.sum() >= count, "the test needs a camera that sees something"
    return points[inside][:count], pixels[inside][:count]


def in_world(dataset: Dataset, point_in_cam: Floats) -> Floats:
    """Return points (N, 3), one an image, in the world: X = R^T (p - t), in the plainest words."""
    rotation = Rotation.from_quat(dataset.images.cam_from_world_quat, scalar_first=True).as_matrix()
    return np.array(
        [r.T @ (p - t) for r, p, t in zip(rotation, point_in_cam, dataset.images.cam_from_world_m, strict=True)]
    )


def residuals(rays: Rays, point_in_world: Floats) -> tuple[Floats, Floats]:
    """Return (a/c, b/c) in pixels (N, 2) and c (N) of one point a ray."""
    abc = np.einsum("nij,nj->ni", rays.residual_from_world, point_in_world - rays.center_in_world_m)
    return abc[:, :2] / abc[:, 2:], abc[:, 2]


def test_every_model_of_colmap_is_tested() -> None:
    assert {*PARAMS} == {*pycolmap.CameraModelId.__members__} - {"INVALID"}


@pytest.mark.parametrize("model", PARAMS)
def test_a_ray_passes_the_point_that_was_projected(model: str) -> None:
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model])
    point_in_cam, pixels = visible_points(camera)
    dataset = dataset_of(model, PARAMS[model], pixels)
    rays = cast_rays(dataset)
    assert_allclose(np.linalg.norm(rays.direction_in_world, axis=1), 1.0, rtol=0, atol=1e-12)
    offset = in_world(dataset, point_in_cam) - rays.center_in_world_m
    along = np.einsum("ni,ni->n", offset, rays.direction_in_world)
    assert_allclose(along, np.linalg.norm(point_in_cam, axis=1), rtol=1e-9)
    beside = np.linalg.norm(offset - along[:, None] * rays.direction_in_world, axis=1)
    assert np.all(beside < 1e-6 * along)
    residual_px, depth = residuals(rays, in_world(dataset, point_in_cam))
    assert_allclose(residual_px, 0.0, atol=1e-3)
    assert np.all(depth > 0.0)


def reprojection_errors(camera: pycolmap.Camera, point_in_cam: Floats, pixels: Floats) -> Floats:
    """Return projection - pixel (N, 2); around a panorama the short way."""
    error: Floats = np.asarray(camera.img_from_cam(point_in_cam)) - pixels
    if camera.is_spherical():
        error[:, 0] = (error[:, 0] + WIDTH / 2) % WIDTH - WIDTH / 2
    return error


@pytest.mark.parametrize("model", WITHOUT_DISTORTION)
def test_without_distortion_the_residual_is_the_reprojection_error_at_any_distance(model: str) -> None:
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model])
    point_in_cam, pixels = visible_points(camera)
    dataset = dataset_of(model, PARAMS[model], pixels)
    elsewhere = np.roll(point_in_cam, 1, axis=0)
    error_px = reprojection_errors(camera, elsewhere, pixels)
    assert np.median(np.abs(error_px)) > 100.0
    residual_px, depth = residuals(cast_rays(dataset), in_world(dataset, elsewhere))
    assert_allclose(residual_px, error_px, rtol=0, atol=1e-5)
    assert_allclose(depth, elsewhere[:, 2], rtol=1e-9)


@pytest.mark.parametrize("model", [model for model in PARAMS if model not in WITHOUT_DISTORTION])
def test_with_distortion_the_residual_is_the_reprojection_error_to_first_order(model: str) -> None:
    """A step ten times shorter must leave a hundredth of the difference."""
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model])
    point_in_cam, pixels = visible_points(camera)
    if camera.is_spherical():  # At the poles one pixel is any step.
        level = np.abs(point_in_cam[:, 1]) < 0.95 * np.linalg.norm(point_in_cam, axis=1)
        point_in_cam, pixels = point_in_cam[level], pixels[level]
    dataset = dataset_of(model, PARAMS[model], pixels)
    rays = cast_rays(dataset)
    step = np.random.default_rng(2).normal(0.0, 1.0, point_in_cam.shape)
    step *= np.linalg.norm(point_in_cam, axis=1, keepdims=True) / np.linalg.norm(step, axis=1, keepdims=True)
    differences = []
    for length in (1e-2, 1e-3):
        moved = point_in_cam + length * step
        error_px = reprojection_errors(camera, moved, pixels)
        seen = np.isfinite(error_px).all(axis=1)
        assert seen.mean() > 0.95
        residual_px, _ = residuals(rays, in_world(dataset, moved))
        differences.append(np.linalg.norm(residual_px - error_px, axis=1)[seen])
        moved_px = np.linalg.norm(error_px[seen], axis=1)
    short = differences[1]
    assert np.median(moved_px) > 0.1
    assert np.all(short < 0.05 + 0.05 * moved_px)
    assert np.median(short) < 0.02 * np.median(differences[0]) + 1e-4


def test_a_point_behind_the_camera_has_a_negative_depth() -> None:
    for model in PARAMS:
        camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model])
        point_in_cam, pixels = visible_points(camera, count=50)
        dataset = dataset_of(model, PARAMS[model], pixels)
        _, depth = residuals(cast_rays(dataset), in_world(dataset, -point_in_cam))
        assert np.all(depth < 0.0)


def test_the_seam_of_a_panorama_is_no_jump() -> None:
    """A detection 0.2 px right of the left edge, a point that projects 0.3 px left of the right edge."""
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=PARAMS["EQUIRECTANGULAR"])
    pixels = np.array([[0.2, 300.0], [WIDTH - 0.3, 300.0], [0.0, 250.0], [WIDTH, 250.0]])
    other = np.array([[WIDTH - 0.3, 300.0], [0.2, 300.0], [WIDTH, 250.0], [0.0, 250.0]])
    dataset = dataset_of("EQUIRECTANGULAR", PARAMS["EQUIRECTANGULAR"], pixels)
    point = in_world(dataset, 20.0 * np.asarray(camera.cam_ray_from_img(other)))
    residual_px, depth = residuals(cast_rays(dataset), point)
    assert_allclose(residual_px, [[-0.5, 0.0], [0.5, 0.0], [0.0, 0.0], [0.0, 0.0]], rtol=0, atol=1e-3)
    assert np.all(depth > 0.0)


@pytest.mark.parametrize(
    ("model", "params", "pixel"),
    [
        ("SIMPLE_FISHEYE", [150.0, 400.0, 300.0], [790.0, 300.0]),
        ("OPENCV_FISHEYE", [150.0, 150.0, 400.0, 300.0, 0.0, 0.0, 0.0, 0.0], [400.0, 590.0]),
        ("FOV", [250.0, 250.0, 400.0, 300.0, 1.2], [5.0, 5.0]),
        ("SIMPLE_RADIAL", [500.0, 400.0, 300.0, -0.5], [795.0, 300.0]),
        ("EUCM", [200.0, 200.0, 400.0, 300.0, 0.8, 1.2], [790.0, 300.0]),
        ("EQUIRECTANGULAR", [800.0, 600.0], [400.0, -5.0]),
    ],
)
def test_a_pixel_without_a_ray_is_nan_and_the_others_are_not(
    model: str, params: list[float], pixel: list[float]
) -> None:
    """COLMAP answers some of these with a ray of another pixel, which would vote for the wrong place."""
    rays = cast_rays(dataset_of(model, params, np.array([[410.0, 310.0], pixel])))
    assert_array_equal(np.isnan(rays.direction_in_world), [[False] * 3, [True] * 3])
    assert_array_equal(np.isnan(rays.residual_from_world).all(axis=(1, 2)), [False, True])
    assert not np.isnan(rays.residual_from_world[0]).any()


def test_detections_find_their_images_and_cameras() -> None:
    dataset = small_dataset()
    rays = cast_rays(dataset)
    assert len(rays) == 5
    assert_array_equal(rays.image_row, [0, 1, 2, 2, 3])
    assert_array_equal(rays.camera_row, [0, 0, 1, 1, 1])
    assert_array_equal(rays.class_code, [0, 0, 0, 1, 1])
    # The second image looks along world y from (4, 0, 1.5); its detection is 40 px above the centre.
    assert_allclose(rays.center_in_world_m[1], [4.0, 0.0, 1.5], rtol=0, atol=1e-12)
    assert_allclose(rays.direction_in_world[1], np.array([0.0, 500.0, 40.0]) / np.hypot(500.0, 40.0), atol=1e-12)


# Conventions of poses and pixels.


def test_cam_from_world_takes_the_world_into_camera_axes() -> None:
    """point_in_cam = R point_in_world + t with the quaternion in the order w, x, y, z."""
    images = small_dataset().images.replace(
        cam_from_world_quat=np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (4, 1)),
        cam_from_world_m=np.tile([1.0, 2.0, 3.0], (4, 1)),
    )
    # A quarter turn about z takes x to y and y to -x.
    assert_allclose(rotation_matrices(images)[0], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    assert_allclose(rotation_matrices(images)[0] @ camera_centers(images)[0] + [1.0, 2.0, 3.0], 0.0, atol=1e-14)
    assert_allclose(camera_centers(images)[0], [-2.0, 1.0, -3.0], atol=1e-14)


def test_camera_axes_are_x_right_y_down_z_forward() -> None:
    dataset = dataset_of("PINHOLE", PARAMS["PINHOLE"], np.array([[402.0, 297.0], [502.0, 297.0], [402.0, 397.0]]))
    identity = dataset.images.replace(
        cam_from_world_quat=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), cam_from_world_m=np.zeros((3, 3))
    )
    forward, right, down = cast_rays(Dataset(**{**vars(dataset), "images": identity})).direction_in_world
    assert_allclose(forward, [0.0, 0.0, 1.0], atol=1e-12)
    assert right[0] > 0.1
    assert down[1] > 0.1


def test_the_centre_of_the_top_left_pixel_is_at_one_half() -> None:
    """A centred 2 x 2 camera has its principal point at 1, so that pixel (0.5, 0.5) lies half a pixel off it."""
    camera = colmap_camera(
        Cameras(
            np.array([1]), Categories.from_texts(["SIMPLE_PINHOLE"]), np.array([2]), np.array([2]),
            [np.array([10.0, 1.0, 1.0])],
        ),
        0,
    )  # fmt: skip
    assert_allclose(np.asarray(camera.img_from_cam(np.array([[-0.05, -0.05, 1.0]]))), [[0.5, 0.5]], atol=1e-12)
    assert pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 10.0, 2, 2).params.tolist() == [
        10.0,
        1.0,
        1.0,
    ]


@pytest.mark.parametrize("model", WITHOUT_DISTORTION)
def test_pinholes_are_those_of_colmap_to_the_bit(model: str) -> None:
    random = np.random.default_rng(3)
    cameras = dataset_of(model, PARAMS[model], np.array([[402.0, 297.0]])).cameras
    ours, theirs = lens_of(cameras, 0), colmap_camera(cameras, 0)
    assert isinstance(ours, Pinhole)
    pixel = np.concatenate([random.uniform(-WIDTH, 2.0 * WIDTH, (1000, 2)), [[np.nan, 1.0]]])
    assert_array_equal(ours.cam_ray_from_img(pixel), theirs.cam_ray_from_img(pixel))
    point = np.concatenate([random.normal(size=(1000, 3)), [[1.0, 1.0, 0.0], [1.0, 1.0, 1e-16], [np.nan, 1.0, 1.0]]])
    assert_array_equal(ours.img_from_cam(point), theirs.img_from_cam(point))
    assert (ours.width, ours.height) == (theirs.width, theirs.height)
    assert ours.is_perspective_pinhole() == theirs.is_perspective_pinhole()
    assert ours.is_spherical() == theirs.is_spherical()
    assert names_of_params(model) == theirs.params_info


@pytest.mark.parametrize("model", camera_models())
def test_focal_lengths_and_principal_points_are_where_colmap_has_them(model: str) -> None:
    names = names_of_params(model)
    assert names is not None
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=np.ones(len(names.split(","))))
    assert places_of_params(model) == (list(theirs.focal_length_idxs()), list(theirs.principal_point_idxs()))


# The same city through other cameras.


POSES_STAY = MapConfig().with_settings(["correct_poses=0"])


def test_a_city_is_mapped_as_well_through_any_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rays, so the same angular noise: as many objects, as exactly, whatever pixels they are in."""
    monkeypatch.setattr("camera_models.build_map", lambda dataset, _: build_map(dataset, POSES_STAY))
    result = measure(block(frame_spacing_m=4.0, standing_interval_s=2.0, **SHORT_STREETS), [5])
    found = {name: result[name]["found"] for name in ("pinhole", "opencv", "fisheye", "equirectangular")}
    assert found["pinhole"] >= 0.9 * result["pinhole"]["objects"]
    assert all(abs(other - found["pinhole"]) <= 1 for other in found.values()), found
    assert result["largest_difference"]["rms_m"] < 0.15, result


def test_of_a_panorama_the_side_that_is_never_searched_is_not_looked_at() -> None:
    """Boxes of pinholes put into panoramas: what is aside or behind has no box, and is as real. Else 26 are found."""
    few = PRESETS["small"].with_settings(["frame_spacing_m=5", "standing_interval_s=2"])
    city = simulate(few, seed=0, name="ahead")
    found, objects, _ = distances_m(seen_through(city, *cameras_like(city)["equirectangular"]), POSES_STAY)
    assert len(found) >= objects - 1


def test_centers_and_directions_are_those_of_the_rotations() -> None:
    random = np.random.default_rng(2)
    quat = random.normal(size=(9000, 4))
    images = small_dataset().images.take(np.zeros(len(quat), np.int64))
    images = images.replace(
        cam_from_world_quat=quat / np.linalg.norm(quat, axis=1)[:, None],
        cam_from_world_m=random.normal(0.0, 1000.0, (len(quat), 3)),
    )
    rotation, center_m = camera_poses(images)
    assert_array_equal(camera_centers(images), center_m)
    assert_array_equal(directions_down(images), rotation[:, 1])
