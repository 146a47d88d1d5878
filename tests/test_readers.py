"""Readers: what others wrote comes in with its conventions converted, or is refused in one clear line."""

from __future__ import annotations

import gc
import gzip
import inspect
import json
import runpy
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pycolmap
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from reading import refusal
from valuemap.cameras import camera_centers, cast_rays
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.errors import InputError, SettingError
from valuemap.readers import READERS
from valuemap.readers.cameras_of import parse_camera
from valuemap.readers.colmap import read_colmap
from valuemap.readers.detections import DetectionFile
from valuemap.readers.kitti import read_kitti
from valuemap.readers.names import ambiguous, match_images, same_but_for_zeros
from valuemap.tables.table import table_to_arrow

Floats = NDArray[np.float64]

MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
ROOT = Path(__file__).parents[1]
KITTI_SIGNS = ROOT.parent / "shared" / "data" / "kitti_signs"

NAMES = ("a/0.jpg", "a/1.jpg", "a/2.jpg", "b/0.jpg", "b/1.jpg", "b/2.jpg")
# Camera axes (x right, y down, z forward) of level cameras that look along world y, with z up.
CAM_FROM_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
POINTS_IN_WORLD_M = np.array([[0.0, 20.0, 3.0], [4.0, 25.0, 6.0]])


def camera_of(model: str) -> pycolmap.Camera:
    """A 640 x 480 camera with some distortion of every kind that the model has."""
    camera = pycolmap.Camera(model=model, width=640, height=480, camera_id=3)
    values = {
        "f": 500,
        "fx": 500,
        "fy": 510,
        "cx": 322,
        "cy": 238,
        "w": 640,
        "h": 480,
        "omega": 0.5,
        "beta": 1.1,
    }
    values |= {"alpha": 0.5, "k1": -0.05, "k": -0.05, "k2": 0.01}
    camera.params = [values.get(name.strip(), 1e-3) for name in camera.params_info.split(",")]
    return camera


def model_of(model: str = "PINHOLE", *, names: tuple[str, ...] = NAMES) -> pycolmap.Reconstruction:
    """One camera along x, images with ids from 11 on, each looking a little elsewhere."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera_of(model))
    for i, name in enumerate(names):
        rotation = Rotation.from_euler("xyz", [0.02 * i, -0.05 * i, 0.01], degrees=False).as_matrix() @ CAM_FROM_LEVEL
        center = np.array([2.0 * i - 4.0, 0.1 * i, 1.5])
        quaternion = Rotation.from_matrix(rotation).as_quat()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), -rotation @ center)
        image = pycolmap.Image(name=name, camera_id=3, image_id=11 + i)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0 + i]))] * i)
        reconstruction.add_image_with_trivial_frame(image, pose)
    return reconstruction


def write_model(reconstruction: pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(folder)
    return folder


def images_of(reconstruction: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """pycolmap keeps them in no order."""
    return [reconstruction.images[i] for i in sorted(reconstruction.images)]


def boxes_on(reconstruction: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    """A box of 10 x 20 px around each point in each image that it projects into."""
    found = []
    for image in images_of(reconstruction):
        for number, point in enumerate(POINTS_IN_WORLD_M):
            pixel = image.project_point(point)
            if pixel is not None and 0 <= pixel[0] <= 640 and 0 <= pixel[1] <= 480:
                bbox = [pixel[0] - 5.0, pixel[1] - 10.0, 10.0, 20.0]
                found.append(
                    {
                        "image_id": image.image_id,
                        "category_id": number,
                        "bbox": bbox,
                        "score": 0.5 + number / 4,
                    }
                )
    return found


def coco_of(reconstruction: pycolmap.Reconstruction) -> dict[str, Any]:
    images = [
        {"id": image.image_id, "file_name": image.name, "width": 640, "height": 480}
        for image in images_of(reconstruction)
    ]
    categories = [{"id": 0, "name": "light"}, {"id": 1, "name": "sign"}]
    return {"images": images, "annotations": boxes_on(reconstruction), "categories": categories}


def write_json(content: Any, path: Path) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


@pytest.fixture
def model_dir(tmp_path: Path) -> Path:
    return write_model(model_of(), tmp_path / "model")


@pytest.fixture
def coco(tmp_path: Path) -> Path:
    return write_json(coco_of(model_of()), tmp_path / "boxes.json")


def distance_to_rays(dataset: Dataset) -> Floats:
    """Distances (N) of the points whose boxes these are from the rays of the boxes."""
    rays = cast_rays(dataset)
    point = POINTS_IN_WORLD_M[[["light", "sign"].index(name) for name in dataset.detections.class_name.texts()]]
    from_ray: Floats = np.linalg.norm(np.cross(rays.direction_in_world, point - rays.center_in_world_m), axis=1)
    return from_ray


def same(a: Dataset, b: Dataset) -> bool:
    tables = ("cameras", "images", "detections")
    equal = all(table_to_arrow(getattr(a, name)).equals(table_to_arrow(getattr(b, name))) for name in tables)
    return equal and a.frame == b.frame


# COLMAP: geometry.


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_boxes_of_projected_points_become_rays_through_them(tmp_path: Path, model: str, text: bool) -> None:
    reconstruction = model_of(model)
    folder = write_model(reconstruction, tmp_path / "model", text=text)
    coco = write_json(coco_of(reconstruction), tmp_path / "boxes.json")
    dataset = read_colmap(folder, detections=coco)
    assert len(dataset.detections) >= 8
    assert distance_to_rays(dataset).max() < 1e-6
    np.testing.assert_allclose(dataset.detections.size_px, [[10.0, 20.0]] * len(dataset.detections))


def test_poses_names_and_ids_are_colmaps(model_dir: Path, coco: Path) -> None:
    dataset, expected = read_colmap(model_dir, detections=coco), model_of()
    assert dataset.images.image_id.tolist() == [11, 12, 13, 14, 15, 16]
    assert dataset.images.name.to_pylist() == list(NAMES)
    assert dataset.cameras.camera_id.tolist() == [3]
    assert dataset.images.timestamp_s is None
    centers = [expected.images[i].projection_center() for i in dataset.images.image_id]
    np.testing.assert_allclose(camera_centers(dataset.images), centers, atol=1e-12)


def test_a_dataset_of_a_model_can_be_written_and_read(model_dir: Path, coco: Path, tmp_path: Path) -> None:
    dataset = READERS["colmap"](model_dir, detections=coco)
    write_dataset(dataset, tmp_path / "dataset")
    assert same(read_dataset(tmp_path / "dataset"), dataset)


def test_binary_is_preferred_to_text(tmp_path: Path, coco: Path) -> None:
    folder = write_model(model_of(), tmp_path / "model")
    write_model(model_of(names=tuple(f"text/{name}" for name in NAMES)), folder, text=True)
    assert read_colmap(folder, detections=coco).images.name[0].as_py() == "a/0.jpg"
    (folder / "images.bin").unlink()
    box = {"file_name": "text/a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    dataset = read_colmap(folder, detections=write_json([box], coco))
    assert dataset.images.name[0].as_py() == "text/a/0.jpg"


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("absent", ["points3D", "rigs", "frames", "rigs frames"])
def test_points_rigs_and_frames_may_be_absent(tmp_path: Path, coco: Path, text: bool, absent: str) -> None:
    whole = write_model(model_of(), tmp_path / "whole", text=text)
    part = shutil.copytree(whole, tmp_path / "part")
    for name in absent.split():
        (part / f"{name}{'.txt' if text else '.bin'}").unlink()
    assert same(read_colmap(part, detections=coco), read_colmap(whole, detections=coco))


@pytest.mark.parametrize("text", [False, True])
def test_poses_in_rigs_are_composed(tmp_path: Path, text: bool) -> None:
    reconstruction = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = camera_of("OPENCV")
        camera.camera_id = camera_id
        reconstruction.add_camera(camera)
    rig = pycolmap.Rig(rig_id=1)
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id) for camera_id in (1, 2)]
    right_from_left = pycolmap.Rigid3d(
        pycolmap.Rotation3d(Rotation.from_euler("y", 0.1).as_quat()), np.array([-0.5, 0.0, 0.1])
    )
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], right_from_left)
    reconstruction.add_rig(rig)
    left_from_world = []
    for number in range(3):
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(Rotation.from_matrix(CAM_FROM_LEVEL).as_quat()),
            -CAM_FROM_LEVEL @ np.array([2.0 * number - 2.0, 0.0, 1.5]),
        )
        frame = pycolmap.Frame(frame_id=number + 1, rig_id=1)
        for sensor, camera_id in zip(sensors, (1, 2), strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, 10 * camera_id + number))
        frame.rig_from_world = pose
        reconstruction.add_frame(frame)
        for side, camera_id in zip(("left", "right"), (1, 2), strict=True):
            image = pycolmap.Image(name=f"{side}/{number}.jpg", camera_id=camera_id, image_id=10 * camera_id + number)
            image.frame_id = number + 1
            reconstruction.add_image(image)
        reconstruction.register_frame(number + 1)
        left_from_world.append(pose)
    folder = write_model(reconstruction, tmp_path / "model", text=text)
    coco = write_json(coco_of(reconstruction), tmp_path / "boxes.json")
    dataset = read_colmap(folder, detections=coco)
    expected = [pose.matrix() for pose in left_from_world]
    expected += [(right_from_left * pose).matrix() for pose in left_from_world]
    rotation = Rotation.from_quat(dataset.images.cam_from_world_quat, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation, np.array(expected)[:, :, :3], atol=1e-12)
    np.testing.assert_allclose(dataset.images.cam_from_world_m, np.array(expected)[:, :, 3], atol=1e-12)
    assert dataset.images.rig_id is not None
    assert dataset.images.rig_id.tolist() == [1, 2, 3, 1, 2, 3]
    assert distance_to_rays(dataset).max() < 1e-6


# COLMAP: up, anchor, metres, passes.


def test_up_is_the_mean_of_the_cameras_own_unless_given(model_dir: Path, coco: Path) -> None:
    mean = np.mean([-image.cam_from_world().rotation.matrix()[1] for image in images_of(model_of())], axis=0)
    np.testing.assert_allclose(read_colmap(model_dir, detections=coco).frame.up, mean / np.linalg.norm(mean))
    given = read_colmap(model_dir, detections=coco, up=(0.0, 0.0, 2.0))
    assert given.frame.up == (0.0, 0.0, 1.0)
    assert not given.frame.is_georeferenced


def test_an_anchor_makes_the_frame_georeferenced(model_dir: Path, coco: Path) -> None:
    assert read_colmap(model_dir, detections=coco, anchor=(52.0, 4.9, 43.0)).frame.anchor == (52.0, 4.9, 43.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"up": (0.0, 0.0, 0.0)}, "up: expected a direction"),
        ({"up": (0.0, float("nan"), 0.0)}, "up: expected a direction"),
        ({"anchor": (120.0, 4.9, 43.0)}, "anchor: expected latitude"),
        ({"anchor": (52.0, 4.9, 43.0), "up": (0.0, 0.0, 1.0)}, "expected at most one"),
    ],
)
def test_impossible_frames_are_setting_errors(model_dir: Path, coco: Path, options: dict[str, Any], said: str) -> None:
    with pytest.raises(SettingError, match=said):
        read_colmap(model_dir, detections=coco, **options)


def posed(rotations: list[Rotation], centers: list[list[float]] | None = None) -> pycolmap.Reconstruction:
    """The usual model with other rotations (camera from world), and other camera centres."""
    reconstruction = model_of()
    for number, (image, rotation) in enumerate(zip(images_of(reconstruction), rotations, strict=True)):
        center = image.projection_center() if centers is None else np.array(centers[number])
        frame = reconstruction.frames[image.frame_id]
        quaternion = pycolmap.Rotation3d(rotation.as_quat())
        frame.rig_from_world = pycolmap.Rigid3d(quaternion, -rotation.as_matrix() @ center)
    return reconstruction


def test_cameras_without_a_common_up_need_one_given(tmp_path: Path) -> None:
    reconstruction = posed([Rotation.from_euler("z", 60.0 * i, degrees=True) for i in range(6)])
    folder = write_model(reconstruction, tmp_path / "model")
    image = {"image_id": "a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    coco = write_json([image], tmp_path / "boxes.json")
    assert "up directions cancel out" in refusal(lambda: read_colmap(folder, detections=coco))
    assert read_colmap(folder, detections=coco, up=(1.0, 0.0, 0.0)).frame.up == (1.0, 0.0, 0.0)


def test_an_anchor_on_poses_with_y_down_is_refused(tmp_path: Path) -> None:
    folder = write_model(posed([Rotation.identity()] * 6), tmp_path / "model")
    box = {"file_name": "a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    coco = write_json([box], tmp_path / "boxes.json")
    np.testing.assert_allclose(read_colmap(folder, detections=coco).frame.up, (0.0, -1.0, 0.0), atol=1e-12)
    said = refusal(lambda: read_colmap(folder, detections=coco, anchor=(52.0, 4.9, 43.0)))
    assert "the cameras' own up is (0.00, -1.00, 0.00)" in said.replace("-0.00", "0.00")


@pytest.mark.parametrize(("step_m", "metric"), [(5e-4, False), (2e-3, True), (900.0, True), (1100.0, False)])
def test_steps_that_cannot_be_metres_are_refused(tmp_path: Path, step_m: float, metric: bool) -> None:
    reconstruction = posed([Rotation.identity()] * 6, [[step_m * i, 0.0, 0.0] for i in range(6)])
    folder = write_model(reconstruction, tmp_path / "model")
    box = {"file_name": "a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    coco = write_json([box], tmp_path / "boxes.json")
    if metric:
        assert len(read_colmap(folder, detections=coco).images) == 6
    else:
        said = refusal(lambda: read_colmap(folder, detections=coco))
        assert "median step" in said
        assert "model_aligner" in said


def test_waiting_images_and_jumps_between_passes_say_nothing_about_scale(tmp_path: Path) -> None:
    x_m = [0.0, 0.0, 0.0, 5e6, 5e6, 5e6 + 1.5]  # Most wait; the passes are 5000 km apart.
    rotations = [Rotation.from_euler("y", 0.1 * i) for i in range(6)]
    reconstruction = posed(rotations, [[x, 0.0, 0.0] for x in x_m])
    folder = write_model(reconstruction, tmp_path / "model")
    box = {"file_name": "a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    coco = write_json([box], tmp_path / "boxes.json")
    assert len(read_colmap(folder, detections=coco).images) == 6
    alone = posed(rotations, [[x, 0.0, 0.0] for x in (0.0, 0.0, 0.0, 0.0, 0.0, 1e-9)])
    said = refusal(lambda: read_colmap(write_model(alone, tmp_path / "alone"), detections=coco, pass_from="none"))
    assert "median step" in said


def test_images_of_a_pass_need_not_be_in_driving_order(tmp_path: Path) -> None:
    """By name, every step of this pass is 3 km, there and back."""
    x_m = [0.0, 3000.0, 2.0, 3002.0, 4.0, 3004.0]
    folder = write_model(posed([Rotation.identity()] * 6, [[x, 0.0, 0.0] for x in x_m]), tmp_path / "model")
    assert len(read_colmap(folder, pass_from="none", up=(0.0, -1.0, 0.0)).images) == 6


def passes(dataset: Dataset) -> list[str]:
    return dataset.images.pass_id.texts()


def test_passes_from_folders_or_none(tmp_path: Path, model_dir: Path, coco: Path) -> None:
    assert passes(read_colmap(model_dir, detections=coco)) == ["a"] * 3 + ["b"] * 3
    assert passes(read_colmap(model_dir, detections=coco, pass_from="none")) == ["all"] * 6
    names = ("0.jpg", "1.jpg", "2.jpg", "x/y/0.jpg", "x/y/1.jpg", "x/y/2.jpg")
    deep = model_of(names=names)
    folder = write_model(deep, tmp_path / "deep")
    found = read_colmap(folder, detections=write_json(coco_of(deep), tmp_path / "deep.json"))
    assert passes(found) == ["all"] * 3 + ["x/y"] * 3


def test_passes_from_a_file(tmp_path: Path, model_dir: Path, coco: Path) -> None:
    lines = [f"{name},{i % 2:03d}" for i, name in enumerate(NAMES)] + ["elsewhere.jpg,9"]
    table = tmp_path / "passes.csv"
    table.write_text("image,pass\n" + "\n".join(reversed(lines)) + "\n")
    assert passes(read_colmap(model_dir, detections=coco, pass_from=str(table))) == ["000", "001"] * 3


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "expected folder, none or a CSV file"),
        ("", "Empty CSV"),
        ("image,pass\n", "no rows"),
        ("name,pass\na/0.jpg,1\n", "expected a column 'image' in the first line, found name, pass"),
        ("image,pass\na/0.jpg\n", "Expected 2 columns"),
        ("image,pass\na/0.jpg,1\na/1.jpg,1\n", "image 'a/2.jpg' of the model is not in it (4 of 6 images)"),
        ("image,pass\na/0.jpg,1\na/0.jpg,2\n", "image 'a/0.jpg' is in two passes, '1' and '2'"),
    ],
)
def test_bad_files_of_passes(tmp_path: Path, model_dir: Path, coco: Path, content: str | None, said: str) -> None:
    table = tmp_path / "passes.csv"
    if content is not None:
        table.write_text(content)
    assert said in refusal(lambda: read_colmap(model_dir, detections=coco, pass_from=str(table)))


# COLMAP: damaged models.


@pytest.mark.parametrize("name", ["cameras", "images", "rigs", "frames"])
def test_a_binary_file_cut_anywhere_is_refused(model_dir: Path, coco: Path, name: str) -> None:
    path = model_dir / f"{name}.bin"
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        assert f"{name}.bin: damaged or cut short" in refusal(lambda: read_colmap(model_dir, detections=coco))
    path.write_bytes(whole + b"\0")
    assert f"{name}.bin: damaged or cut short" in refusal(lambda: read_colmap(model_dir, detections=coco))


@pytest.mark.parametrize("seed", range(20))
def test_garbage_never_ends_in_anything_but_an_input_error(model_dir: Path, coco: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    path = model_dir / f"{('cameras', 'images', 'rigs', 'frames')[seed % 4]}.bin"
    path.write_bytes(random.bytes(int(random.integers(0, 500))))
    assert path.name in refusal(lambda: read_colmap(model_dir, detections=coco))


def test_a_camera_of_impossible_size_is_refused(model_dir: Path, coco: Path) -> None:
    path = model_dir / "cameras.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:16] + struct.pack("<Q", 2**64 - 1) + whole[24:])
    assert "is no size of a picture" in refusal(lambda: read_colmap(model_dir, detections=coco))


def test_folders_that_are_no_model(tmp_path: Path, model_dir: Path, coco: Path) -> None:
    assert "no such folder" in refusal(lambda: read_colmap(tmp_path / "absent", detections=coco))
    assert "no such folder" in refusal(lambda: read_colmap(coco, detections=coco))
    (tmp_path / "empty").mkdir()
    assert "found none of them" in refusal(lambda: read_colmap(tmp_path / "empty", detections=coco))
    (model_dir / "cameras.bin").unlink()
    said = refusal(lambda: read_colmap(model_dir, detections=coco))
    assert "not a COLMAP model: expected cameras.bin and images.bin" in said
    assert "found frames.bin and images.bin and rigs.bin" in said


CAMERAS_TXT = "3 PINHOLE 640 480 500 510 320 240\n"
IMAGES_TXT = "11 1 0 0 0 0 0 0 3 a/0.jpg\n\n12 1 0 0 0 -1 0 0 3 a/1.jpg\n1 2 -1 3 4 77\n"


@pytest.mark.parametrize(
    ("cameras", "images", "said"),
    [
        ("3 NOSUCH 640 480 1 2 3\n", IMAGES_TXT, "cameras.txt line 1: expected CAMERA_ID MODEL WIDTH HEIGHT"),
        ("3 PINHOLE 640 480 500 510\n", IMAGES_TXT, "line 1: PINHOLE expects 4 finite numbers"),
        ("hello\n", IMAGES_TXT, "cameras.txt line 1: expected CAMERA_ID MODEL"),
        ("# none\n", IMAGES_TXT, "line 1: camera 3 of image"),
        (
            "4 PINHOLE 640 480 500 510 320 240\n",
            IMAGES_TXT,
            "line 1: camera 3 of image 'a/0.jpg' is not in cameras.txt",
        ),
        (CAMERAS_TXT, "# Number of images: 3\n" + IMAGES_TXT, "cut short: it announces 3 images and holds 2"),
        ("# Number of cameras: 2\n" + CAMERAS_TXT, IMAGES_TXT, "it announces 2 cameras and holds 1"),
        (CAMERAS_TXT, "", "no image with a pose"),
        (CAMERAS_TXT, "hello\n\n", "images.txt line 1: expected IMAGE_ID"),
        (CAMERAS_TXT, "11 1 0 0 0 0 nan 0 3 a/0.jpg\n\n", "images.txt line 1: expected IMAGE_ID"),
        (CAMERAS_TXT, IMAGES_TXT.replace("a/0", "a/no 0"), "write other letters for the spaces"),
        (CAMERAS_TXT, "4294967296 1 0 0 0 0 0 0 3 a/0.jpg\n\n", "line 1: IMAGE_ID: expected a whole number from 0"),
        (CAMERAS_TXT, "11 1 0 0 0 0 0 0 7 a/0.jpg\n\n", "line 1: camera 7 of image 'a/0.jpg' is not in cameras.txt"),
        (CAMERAS_TXT * 2, IMAGES_TXT, "cameras.txt line 2: CAMERA_ID 3 is there twice"),
        (CAMERAS_TXT.replace("PINHOLE", "pinhole"), IMAGES_TXT, "cameras.txt line 1: expected CAMERA_ID MODEL"),
        (
            CAMERAS_TXT.strip() + " 9\n",
            IMAGES_TXT,
            "cameras.txt line 1: PINHOLE expects 4 finite numbers (fx, fy, cx, cy)",
        ),
        (CAMERAS_TXT, "11 1 0 0 0 0 0 0 3 a b.jpg\n\n", "line 1: expected IMAGE_ID"),
        (
            CAMERAS_TXT,
            IMAGES_TXT.replace("\n\n", "\n"),
            "line 2: expected an empty line, or the points of image",
        ),
        (CAMERAS_TXT, "11 1 0 0 0 0 0 0 3 a/0.jpg", "line 2: expected an empty line, or the points of image"),
        (CAMERAS_TXT, IMAGES_TXT.replace("12 1", "11 1"), "images.txt line 3: IMAGE_ID 11 is there twice"),
        (
            CAMERAS_TXT,
            IMAGES_TXT.replace("a/1", "a/0"),
            "1 image names occur more than once, the first is 'a/0.jpg'",
        ),
        (
            CAMERAS_TXT,
            IMAGES_TXT.replace("12 1", "12 2"),
            "1 of 2 images cannot be used, more than 1 %: its quaternion is not of length 1, or ",
        ),
        (
            CAMERAS_TXT,
            IMAGES_TXT.replace("12 1", "12 0"),
            "1 of 2 images cannot be used, more than 1 %: its quaternion is not of length 1, or ",
        ),
    ],
)
def test_bad_text_models(tmp_path: Path, cameras: str, images: str, said: str) -> None:
    (tmp_path / "cameras.txt").write_text(cameras)
    (tmp_path / "images.txt").write_text(images)
    box = {"file_name": "a/0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    coco = write_json([box], tmp_path / "boxes.json")
    assert said in refusal(lambda: read_colmap(tmp_path, detections=coco))


def test_a_text_model_of_a_windows_editor(tmp_path: Path) -> None:
    for name, text in (("cameras", CAMERAS_TXT), ("images", IMAGES_TXT)):
        (tmp_path / f"{name}.txt").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert read_colmap(tmp_path).images.name.to_pylist() == ["a/0.jpg", "a/1.jpg"]


def test_a_hand_written_text_model(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# mine\n" + CAMERAS_TXT)
    (tmp_path / "images.txt").write_text("# Number of images: 1 (copied)\n" + IMAGES_TXT)
    box = {"file_name": "a/1.jpg", "category_id": 1, "bbox": [315, 230, 10, 20], "score": 0.5}
    dataset = read_colmap(tmp_path, detections=write_json([box], tmp_path / "boxes.json"))
    assert dataset.images.image_id.tolist() == [11, 12]
    rays = cast_rays(dataset)
    np.testing.assert_allclose(rays.direction_in_world, [[0.0, 0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(rays.center_in_world_m, [[1.0, 0.0, 0.0]], atol=1e-12)


def test_a_pose_with_nan_names_its_image(tmp_path: Path, coco: Path) -> None:
    def image(image_id: int, x: float, name: bytes) -> bytes:
        return struct.pack("<I7dI", image_id, 1, 0, 0, 0, x, 0, 0, 3) + name + bytes(9)

    cameras = struct.pack("<QIiQQ4d", 1, 3, 1, 640, 480, 500, 510, 320, 240)
    (tmp_path / "cameras.bin").write_bytes(cameras)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2) + image(1, 0, b"0.jpg") + image(2, np.nan, b"1.jpg"))
    box = {"file_name": "0.jpg", "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    write_json([box, {**box, "file_name": "1.jpg"}], coco)
    said = refusal(lambda: read_colmap(tmp_path, detections=coco))
    assert "a number of its pose is missing or not finite (1, the first is " in said
    assert "image '1.jpg')" in said
    dataset = read_colmap(tmp_path, detections=coco, max_rejected=0.5, up=(0.0, 0.0, 1.0))
    assert dataset.images.name.to_pylist() == ["0.jpg"]
    assert dataset.rejected is not None
    assert dataset.rejected.table.texts() == ["images", "detections"]
    assert dataset.rejected.reason.texts()[1] == "its image was left out"
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 1) + image(1, 0, b"\xe4.jpg"))
    assert "'utf-8' codec" in refusal(lambda: read_colmap(tmp_path, detections=coco))


# COCO.


def as_results(coco: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """The same boxes as a list of results that name their file under `key`."""
    name_of = {image["id"]: image["file_name"] for image in coco["images"]}
    class_of = {category["id"]: category["name"] for category in coco["categories"]}
    return [
        {**box, key: name_of[box["image_id"]], "category_id": class_of[box["category_id"]]}
        for box in coco["annotations"]
    ]


@pytest.mark.parametrize("key", ["file_name", "image_id"])
def test_results_and_annotations_are_the_same(tmp_path: Path, model_dir: Path, coco: Path, key: str) -> None:
    results = write_json(as_results(json.loads(coco.read_text()), key), tmp_path / "results.json")
    assert same(read_colmap(model_dir, detections=results), read_colmap(model_dir, detections=coco))


def test_the_order_of_boxes_images_and_categories_does_not_matter(tmp_path: Path, model_dir: Path, coco: Path) -> None:
    content = json.loads(coco.read_text())
    random = np.random.default_rng(0)
    for number, box in enumerate(content["annotations"]):
        box["bbox"] = [100, 100, 10, 20] if number % 2 else box["bbox"]  # Ties but for class and score.
    first = read_colmap(model_dir, detections=write_json(content, tmp_path / "first.json"))
    for _ in range(5):
        shuffled = {key: [rows[i] for i in random.permutation(len(rows))] for key, rows in content.items()}
        again = read_colmap(model_dir, detections=write_json(shuffled, tmp_path / "again.json"))
        assert same(first, again)


def test_annotations_keep_their_own_ids_where_all_have_one(model_dir: Path, coco: Path) -> None:
    content = json.loads(coco.read_text())
    for number, box in enumerate(content["annotations"]):
        box["id"] = 1000 - 7 * number
    dataset = read_colmap(model_dir, detections=write_json(content, coco))
    expected = {box["id"]: (box["image_id"], box["score"]) for box in content["annotations"]}
    found = dataset.detections
    assert found.detection_id.tolist() == sorted(expected)
    pairs = zip(found.image_id.tolist(), found.score.tolist(), strict=True)
    assert list(pairs) == [expected[i] for i in sorted(expected)]
    content["annotations"][1]["id"] = content["annotations"][0]["id"]
    numbered = read_colmap(model_dir, detections=write_json(content, coco)).detections
    assert numbered.detection_id.tolist() == list(range(len(numbered)))


def test_classes_and_scores_that_are_not_given(tmp_path: Path, model_dir: Path) -> None:
    boxes = [{"image_id": 1, "category_id": 9, "bbox": [10.5, 20.0, 3.0, 5.0]}]
    content = {"images": [{"id": 1, "file_name": "a/0.jpg"}], "annotations": boxes}
    found = read_colmap(model_dir, detections=write_json(content, tmp_path / "boxes.json")).detections
    assert found.class_name.texts() == ["class-9"]
    assert found.score.tolist() == [1.0]
    assert found.center_px.tolist() == [[12.0, 22.5]]


def test_images_without_detections_may_be_unknown_to_the_model(tmp_path: Path, model_dir: Path, coco: Path) -> None:
    content = json.loads(coco.read_text())
    content["images"].append({"id": 99, "file_name": "a/dropped.jpg", "width": 1, "height": 1})
    with_dropped = read_colmap(model_dir, detections=write_json(content, tmp_path / "more.json"))
    assert same(with_dropped, read_colmap(model_dir, detections=coco))


def test_whole_numbers_of_coco_may_have_a_point(model_dir: Path, coco: Path, tmp_path: Path) -> None:
    """pandas writes 3.0 where a column has gaps."""
    content = json.loads(coco.read_text())
    for box in content["annotations"]:
        box |= {"image_id": float(box["image_id"]), "category_id": float(box["category_id"])}
    pointed = read_colmap(model_dir, detections=write_json(content, tmp_path / "pointed.json"))
    assert same(pointed, read_colmap(model_dir, detections=coco))


def test_names_match_exactly_or_by_a_base_name_that_is_nobody_elses() -> None:
    known = ["cam0/1.jpg", "cam0/2.jpg", "cam1/2.jpg"]
    assert match_images(["cam0/2.jpg"], known) == {"cam0/2.jpg": 1}
    assert match_images(["images/1.jpg"], known) == {"images/1.jpg": 0}
    assert match_images(["1.jpg"], known) == {"1.jpg": 0}
    assert match_images(["2.jpg"], known) == {}
    assert match_images(["cam1/1.jpg", "cam0/1.jpg"], known) == {"cam0/1.jpg": 0}
    assert match_images(["cam1/1.jpg", "cam2/1.jpg"], known) == {}


@pytest.mark.parametrize(
    ("name", "known", "is_same"),
    [
        ("pass-0001/7.jpg", "pass-0000/7.jpg", False),
        ("pass-0001/7.txt", "pass-0000/7.jpg", False),
        ("monday/7.jpg", "C:\\run\\friday\\7.jpg", False),
        ("/data/pass-0001/cam0/7.jpg", "pass-0000/cam0/7.jpg", False),
        ("7.jpg", "pass-0000/7.jpg", True),
        ("pass-0001/7.jpg", "7.jpg", True),
        ("labels/pass-0000/7.txt", "images/pass-0000/7.jpg", True),
        ("./labels/7.txt", "images/pass-0000/7.jpg", True),
        ("/data/run/monday/cam0/7.jpg", "tour/monday/cam0/7.jpg", True),
        ("upload/3/0d1f2a3b-7.jpg", "pass-0000/7.jpg", True),
    ],
)
def test_names_in_other_folders_are_not_the_same(name: str, known: str, is_same: bool) -> None:
    assert match_images([name], [known]) == ({name: 0} if is_same else {})


def test_names_are_found_whatever_system_wrote_them() -> None:
    """Windows does not tell capitals from others, and macOS writes an accent as a character of its own."""
    known = ["stra\u00dfe/caf\u00e9.jpg", "monday/1.jpg", "Monday/2.jpg", "monday/2.jpg"]
    assert match_images(["stra\u00dfe/cafe\u0301.jpg"], known) == {"stra\u00dfe/cafe\u0301.jpg": 0}
    assert match_images(["MONDAY\\1.JPG"], known) == {"MONDAY\\1.JPG": 1}
    assert match_images(["Monday/2.jpg"], known) == {"Monday/2.jpg": 2}
    assert match_images(["MONDAY/2.jpg"], known) == {}


@pytest.mark.parametrize(
    "name",
    [
        "1b2c3d4e-street_001.jpg",
        "street-001_jpg.rf.034d0c9f9a0edda727b2bc56fd073177.jpg",
        "street%20001.jpg",
        "s3://bucket/pass%201/street%20001.jpg",
    ],
)
def test_names_with_spaces_are_found_as_tools_write_them(name: str) -> None:
    known = ["pass 1/street 001.jpg", "pass 1/street 002.jpg"]
    assert match_images([name], known) == {name: 0}
    assert match_images([name], [*known, "street_001.jpg", "street-001.jpg", "pass 1/street 001.jpg"]) == {}
    assert match_images(["pass%202/street%20001.jpg"], known) == {}
    assert match_images(["street_001.jpg", "street-001.jpg"], ["street_001.jpg"]) == {"street_001.jpg": 0}


def test_names_of_several_images_are_said_to_be_such() -> None:
    known = ["cam0/07.jpg", "cam1/07.jpg", "cam1/8 a.jpg", "cam1/8_a.jpg"]
    assert ambiguous(["07.jpg", "9.jpg"], known) == ("07.jpg", known[:2])
    assert ambiguous(["1b2c3d4e-8_a.jpg"], known) == ("1b2c3d4e-8_a.jpg", known[2:])
    assert ambiguous(["cam2/07.jpg", "7.jpg"], known) is None
    assert same_but_for_zeros(["07.jpg"], known) is None
    assert same_but_for_zeros(["7.jpg"], known) == ("7.jpg", "cam0/07.jpg")


@pytest.mark.parametrize(("known", "name"), [("20231114/1", "20231115-1"), ("00000012-left", "00000013-left")])
def test_names_that_no_tool_for_labels_gave_are_other_pictures(tmp_path: Path, known: str, name: str) -> None:
    """A date and a counter have eight digits, too."""
    assert match_images([f"{name}.jpg"], [f"{known}.jpg"]) == {}


def test_names_of_paths_in_another_folder_are_found_by_how_they_end() -> None:
    known = ["monday/cam0/7.jpg", "monday/cam1/7.jpg", "friday/cam0/7.jpg"]
    paths = {"C:\\run\\monday\\cam1\\7.png": 1, "/data/run/friday/cam0/7.jpg": 2, "cam0/7.jpg": None, "7.jpg": None}
    assert match_images(list(paths), known) == {path: row for path, row in paths.items() if row is not None}
    assert match_images(["cam1/7.jpg"], known) == {"cam1/7.jpg": 1}


def changed(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    """Make a change in place look like a function from content to content."""

    def apply(content: dict[str, Any]) -> dict[str, Any]:
        change(content)
        return content

    return apply


def first(content: dict[str, Any], **values: Any) -> None:
    content["annotations"][0].update(values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: json.dumps(c)[:-20], "cannot be read as JSON"),
        (lambda _: "", "is empty"),
        (lambda _: "[" * 100_000, "cannot be read as JSON"),
        (lambda _: 5, "expected a list of results, or an object"),
        (lambda _: {"results": []}, "there is no list named annotations"),
        (lambda c: {**c, "images": None}, "there is no list named images"),
        (lambda _: [], "there are no detections in it"),
        (lambda c: {**c, "annotations": []}, "there are no detections in it"),
        (lambda _: ["a"], "results[0]: expected an object, found 'a'"),
        (lambda c: c["annotations"], "results[0]: image_id 11 does not say which file it is (12 entries)"),
        (
            changed(lambda c: first(c, image_id=99)),
            "its image is not among the images with a pose (1, the first is ",
        ),
        (
            changed(lambda c: first(c, image_id=None)),
            "annotations[0]: 'image_id ",
        ),
        (
            changed(lambda c: first(c, image_id=[1])),
            "annotations[0]: 'image_id ",
        ),
        (
            changed(lambda c: c["images"][2].pop("file_name")),
            "images[2]: file_name: expected a text, found None",
        ),
        (changed(lambda c: c["images"][2].update(id=11)), "images[2]: id 11 is there twice"),
        (
            changed(lambda c: c["images"][0].update(file_name="no.jpg")),
            "annotations[0]: 'no.jpg', centre",
        ),
        (
            changed(lambda c: c["images"][0].update(width=1280)),
            "expected 640 x 480 px as in the model, found 1280 x",
        ),
        (changed(lambda c: first(c, bbox=[1, 2, 3])), "a number is missing or not finite (1, the first is "),
        (
            changed(lambda c: first(c, bbox=[1, 2, -3, 4])),
            "its width or height is not above 0 (1, the first is ",
        ),
        (
            changed(lambda c: first(c, bbox=[1, 2, float("nan"), 4])),
            "a number is missing or not finite (1, the first is ",
        ),
        (
            changed(lambda c: first(c, bbox=[1, 2, "3", 4])),
            "a number is missing or not finite (1, the first is ",
        ),
        (
            changed(lambda c: first(c, bbox=[10**400, 2, 3, 4])),
            "a number is missing or not finite (1, the first is ",
        ),
        (changed(lambda c: first(c, bbox=[2000, 2, 3, 4])), "its centre lies outside its picture (1, the first is "),
        (changed(lambda c: first(c, bbox=[1, 2, 1e9, 4])), "it is more than 2 times as large as its picture (1"),
        (changed(lambda c: first(c, bbox=[1, 2, 0, 4])), "its width or height is not above 0 (1"),
        (changed(lambda c: first(c, score=70)), "its score is not from 0 to 1 (1"),
        (changed(lambda c: c["annotations"].extend(c["annotations"])), "the same box is there already (12"),
        (
            changed(lambda c: first(c, score="high")),
            "a number is missing or not finite (1",
        ),
        (
            changed(lambda c: first(c, score=True)),
            "a number is missing or not finite (1",
        ),
        (
            changed(lambda c: c["annotations"][3].pop("category_id")),
            "its class is missing, or not in the list of classes (1, the first is ",
        ),
        (
            changed(lambda c: first(c, category_id=7)),
            "its class is missing, or not in the list of classes (1, the first is ",
        ),
        (changed(lambda c: c["categories"][1].pop("name")), "categories[1]: name: expected a text"),
        (lambda c: {**c, "categories": "light"}, "there is no list named categories"),
    ],
)
def test_bad_coco_files(model_dir: Path, coco: Path, change: Callable[[dict[str, Any]], Any], said: str) -> None:
    gc.collect()  # What earlier tests left cannot be finalized where the stack is full of brackets.
    write_json(change(json.loads(coco.read_text())), coco)
    message = refusal(lambda: read_colmap(model_dir, detections=coco))
    assert said in message
    assert str(coco) in message


def test_unknown_images_are_counted(model_dir: Path, coco: Path) -> None:
    content = json.loads(coco.read_text())
    for image in content["images"][3:]:
        image["file_name"] = f"other/{image['file_name']}x"
    said = refusal(lambda: read_colmap(model_dir, detections=write_json(content, coco)))
    assert "6 of 12 boxes cannot be used, more than 1 %: its image is not among the images with a pose (6, the " in said
    assert "'other/b/0.jpgx'" in said
    assert "as in 'a/0.jpg'" in said
    assert "--max-rejected 0.5" in said


def test_a_missing_coco_file(tmp_path: Path, model_dir: Path) -> None:
    assert "no such file" in refusal(lambda: read_colmap(model_dir, detections=tmp_path / "absent.json"))


# KITTI.

INTRINSICS = (700.0, 710.0, 600.0, 180.0)
IMAGE_SIZE = (1240, 370)


def drive(frames: int = 5) -> Floats:
    """World-from-camera matrices (N, 3, 4) of a drive along z with y down, turning slowly."""
    rotation = Rotation.from_euler("yx", np.stack([0.03 * np.arange(frames), np.full(frames, 0.01)], axis=1))
    center = np.stack([0.1 * np.arange(frames) ** 2, np.zeros(frames), 1.0 * np.arange(frames)], axis=1)
    return np.concatenate([rotation.as_matrix(), center[:, :, None]], axis=2)


def write_kitti(folder: Path, world_from_cam: Floats | None = None, boxes: str | None = None) -> dict[str, Any]:
    """Write poses and boxes around two points, and return the arguments to read them."""
    poses = drive() if world_from_cam is None else world_from_cam
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 12), fmt="%.9e")
    if boxes is None:
        boxes = "frame,x1,y1,x2,y2\n"
        for frame, matrix in enumerate(poses):
            for point in ([2.0, -3.0, 30.0], [-4.0, -1.0, 25.0]):
                x, y, z = matrix[:, :3].T @ (np.array(point) - matrix[:, 3])
                u, v = INTRINSICS[0] * x / z + INTRINSICS[2], INTRINSICS[1] * y / z + INTRINSICS[3]
                boxes += f"{frame},{u - 4},{v - 6},{u + 4},{v + 6}\n"
    (folder / "boxes.csv").write_text(boxes)
    return {
        "poses": folder / "poses.txt",
        "intrinsics": INTRINSICS,
        "image_size": IMAGE_SIZE,
        "detections": folder / "boxes.csv",
    }


def test_kitti_boxes_become_rays_through_the_points(tmp_path: Path) -> None:
    dataset = READERS["kitti"](**write_kitti(tmp_path))
    rays = cast_rays(dataset)
    for point in ([2.0, -3.0, 30.0], [-4.0, -1.0, 25.0]):
        from_ray = np.linalg.norm(np.cross(rays.direction_in_world, point - rays.center_in_world_m), axis=1)
        assert (from_ray < 1e-6).sum() == 5
    np.testing.assert_allclose(camera_centers(dataset.images), drive()[:, :, 3], atol=1e-9)
    assert dataset.images.name.to_pylist()[3] == "000003.png"
    assert dataset.images.image_id.tolist() == [0, 1, 2, 3, 4]
    assert set(passes(dataset)) == {"all"}
    assert set(dataset.detections.class_name.texts()) == {"object"}


def test_kitti_pixels_get_half_a_pixel(tmp_path: Path) -> None:
    arguments = write_kitti(tmp_path, boxes="frame,x1,y1,x2,y2\n1,311,138,324,163\n")
    dataset = read_kitti(**arguments, class_name="sign")
    assert dataset.cameras.params[0].tolist() == [700.0, 710.0, 600.5, 180.5]
    assert dataset.detections.center_px.tolist() == [[318.0, 151.0]]
    assert dataset.detections.size_px.tolist() == [[13.0, 25.0]]
    assert dataset.detections.class_name.texts() == ["sign"]
    assert dataset.detections.score.tolist() == [1.0]


@pytest.mark.parametrize(
    ("name", "options", "center"),
    [
        ("boxes.csv", {"pixel_center": 0.0}, [318.0, 151.0]),
        ("boxes.csv", {"pixel_center": 0.5}, [317.5, 150.5]),
        ("boxes.csv.gz", {}, [318.0, 151.0]),
        ("boxes.tsv", {"format": "csv"}, [318.0, 151.0]),
        ("boxes.csv", {"fractions": True}, [317.5, 150.5]),
        ("boxes.csv", {"fractions": True, "pixel_center": 0.0}, [318.0, 151.0]),
    ],
)
def test_kitti_boxes_are_read_as_somebody_says(
    name: str, options: dict[str, Any], center: list[float], tmp_path: Path
) -> None:
    corners = np.array([[311.0, 138.0], [324.0, 163.0]])
    if "fractions" in options:
        corners /= IMAGE_SIZE
    text = "frame,x1,y1,x2,y2\n1," + ",".join(map(repr, corners.ravel().tolist())) + "\n"
    arguments = write_kitti(tmp_path, boxes=text)
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    dataset = read_kitti(**{**arguments, "detections": DetectionFile(path, **options)})
    assert_allclose(dataset.detections.center_px, [center])
    assert_allclose(dataset.detections.size_px, [[13.0, 25.0]])


def test_the_pixels_of_kitti_from_the_command_line(tmp_path: Path) -> None:
    arguments = write_kitti(tmp_path, boxes="frame,x1,y1,x2,y2\n1,311,138,324,163\n")
    command = ["import", "kitti", "--poses", str(arguments["poses"]), "--detections", str(arguments["detections"])]
    command += ["--intrinsics", *map(str, INTRINSICS), "--image-size", *map(str, IMAGE_SIZE)]
    for options, x in (([], 318.0), (["--detection-pixel-center", "0.5"], 317.5)):
        done = CliRunner().invoke(app, [*command, "--force", "--out", str(tmp_path / "out"), *options])
        assert done.exit_code == 0, done.output
        assert read_dataset(tmp_path / "out").detections.center_px[0, 0] == x


def test_kitti_class_score_and_any_order_of_rows(tmp_path: Path) -> None:
    rows = ["3,4,5,10,20,0.25,light", "1,4,5,10,20,0.5,sign", "1,4,5,10,20,0.75,light", "1,4,5,9,20,0.5,sign"]
    datasets = []
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        boxes = "frame,x1,y1,x2,y2,score,class\n" + "\n".join(rows[i] for i in order) + "\n"
        datasets.append(read_kitti(**write_kitti(tmp_path, boxes=boxes)))
    assert same(datasets[0], datasets[1])
    assert same(datasets[0], datasets[2])
    found = datasets[0].detections
    assert found.image_id.tolist() == [1, 1, 1, 3]
    assert found.class_name.texts() == ["sign", "light", "sign", "light"]
    assert found.score.tolist() == [0.5, 0.75, 0.5, 0.25]


def test_kitti_up_is_the_mean_of_the_cameras_own_unless_given(tmp_path: Path) -> None:
    arguments = write_kitti(tmp_path)
    mean = -drive()[:, :, 1].mean(axis=0)
    np.testing.assert_allclose(read_kitti(**arguments).frame.up, mean / np.linalg.norm(mean), atol=1e-8)
    assert read_kitti(**arguments, up=(0.0, -2.0, 0.0)).frame.up == (0.0, -1.0, 0.0)


def test_kitti_poses_that_cannot_be_metres_are_refused(tmp_path: Path) -> None:
    poses = drive()
    poses[:, :, 3] *= 1e-5
    assert "median step" in refusal(lambda: read_kitti(**write_kitti(tmp_path, poses)))


def test_kitti_rotations_may_be_rounded(tmp_path: Path) -> None:
    poses = drive()
    poses[:, :, :3] = poses[:, :, :3].round(4)
    dataset = read_kitti(**write_kitti(tmp_path, poses))
    np.testing.assert_allclose(np.linalg.norm(dataset.images.cam_from_world_quat, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(camera_centers(dataset.images), drive()[:, :, 3], atol=1e-8)


def spoilt(row: int, change: Callable[[str], str]) -> Callable[[str], str]:
    """Change one row of a text."""
    return lambda text: "\n".join(change(line) if i == row else line for i, line in enumerate(text.splitlines()))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _: "", "is empty"),
        (
            spoilt(2, lambda line: line.rsplit(" ", 1)[0]),
            "line 3 (frame 2): expected 12 numbers, found 11 fields",
        ),
        (
            spoilt(2, lambda line: "7 " + line),
            "line 3 (frame 2): expected 12 numbers, found 13 fields",
        ),
        (spoilt(2, lambda _: ""), "line 3 (frame 2): expected 12 numbers, found 0 fields"),
        (spoilt(2, lambda _: "7"), "line 3 (frame 2): expected 12 numbers, found 1 field: 7"),
        (
            spoilt(1, lambda line: "one " + line.split(" ", 1)[1]),
            "line 2 (frame 1): expected 12 numbers",
        ),
        (spoilt(4, lambda _: "2 0 0 1 0 2 0 1 0 0 2 1"), "line 5 (frame 4): expected a rotation"),
        (spoilt(4, lambda _: "-1 0 0 1 0 1 0 1 0 0 1 1"), "line 5 (frame 4): expected a rotation"),
    ],
)
def test_bad_kitti_poses(tmp_path: Path, change: Callable[[str], str], said: str) -> None:
    arguments = write_kitti(tmp_path)
    poses: Path = arguments["poses"]
    poses.write_text(change(poses.read_text()))
    message = refusal(lambda: read_kitti(**arguments))
    assert said in message
    assert str(poses) in message


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        ("", "Empty CSV file"),
        ("frame,x1,y1,x2,y2\n", "no rows after the first line"),
        ("frame,x1,y1,x2\n1,2,3,4\n", "expected a column 'y2' in the first line, found frame, x1, y1, x2"),
        ("frame,x1,y1,x2,y2\n1,2,3,4\n", "Row #2: Expected 5 columns, got 4"),
        (
            "frame,x1,y1,x2,y2\n1,2,3,4,5\n1,2,3,,5\n",
            "1 of 2 boxes cannot be used, more than 1 %: a number is missing or not finite (1, the first is ",
        ),
        ("frame,x1,y1,x2,y2\n1.5,2,3,4,5\n", "boxes.csv line 2: 'frame 1.5', centre"),
        (
            "frame,x1,y1,x2,y2\n1,2,3,4,5\n5,2,3,4,5\n",
            "boxes.csv line 3: 'frame 5', centre",
        ),
        ("frame,x1,y1,x2,y2\n-1,2,3,4,5\n", "boxes.csv line 2: 'frame -1', centre"),
        ("frame,x1,y1,x2,y2\n1,2,nan,4,5\n", "a number is missing or not finite (1"),
        ("frame,x1,y1,x2,y2,score\n1,2,3,4,5,inf\n", "a number is missing or not finite (1"),
        (
            "frame,x1,y1,x2,y2\n1,2,3,4,5\n1,5,3,4,5\n",
            "its width or height is not above 0 (1, the first is ",
        ),
        ("frame,x1,y1,x2,y2\n1,2000,3,2004,5\n", "its centre lies outside its picture (1"),
        (
            "frame,x1,y1,x2,y2,label,conf\n1,2,3,4,5,light,0.4\n",
            "has no column 'class', and its column 'label' is none of image, class, x1, y1, x2, y2, frame",
        ),
        ("frame,x1,y1,x2,y2,class,conf\n1,2,3,4,5,light,0.4\n", "has no column 'score', and its column 'conf' is none"),
    ],
)
def test_bad_kitti_boxes(tmp_path: Path, boxes: str, said: str) -> None:
    assert said in refusal(lambda: read_kitti(**write_kitti(tmp_path, boxes=boxes)))


@pytest.mark.parametrize(
    "spoil",
    [{"intrinsics": (0.0, 1.0, 2.0, 3.0)}, {"intrinsics": (1.0, 1.0, np.nan, 3.0)}, {"image_size": (0, 5)}],
)
def test_impossible_kitti_cameras_are_setting_errors(tmp_path: Path, spoil: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match=r"expected (fx fy cx cy|a size) "):
        read_kitti(**{**write_kitti(tmp_path), **spoil})


@pytest.mark.parametrize("heading", [np.nan, np.inf, 361.0])
def test_a_heading_that_is_none_is_not_blamed_on_the_anchor(tmp_path: Path, heading: float) -> None:
    arguments = write_kitti(tmp_path)
    said = refusal(lambda: read_kitti(**arguments, anchor=(51.0, 0.0, 5.0), heading_deg=heading))
    assert said.startswith(f"heading: expected degrees from -360 to 360, found {heading:g} | ")


def test_missing_kitti_files(tmp_path: Path) -> None:
    for name in ("poses", "detections"):
        arguments = {**write_kitti(tmp_path), name: tmp_path / "absent"}
        with pytest.raises(InputError, match="absent: no such file"):
            read_kitti(**arguments)


# The benchmark that reads real data.


def kitti_signs() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "kitti_signs.py"), run_name="kitti_signs")


def test_the_benchmark_counts_what_it_says() -> None:
    tracks = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    signs = np.array([[0.5, 0.0, 0.0], [20.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
    labels = np.array([[0, 0, 0.1], [0, 0, -0.2], [21.5, 0, 0], [30, 1, 0], [50, 0, 0]])
    score = kitti_signs()["score_labels"](labels, signs, np.array([True, True, False]), tracks)
    assert (score.labels, score.right_labels, score.distinct_labels) == (5, 4, 3)
    assert (score.signs, score.signs_found, score.signs_matched) == (2, (2, 1, 0), (2, 1, 0))
    assert (score.tracks, score.tracks_found, score.tracks_matched) == (2, 1, 1)
    np.testing.assert_allclose(score.distance_m, [0.1])
    assert kitti_signs()["add_up"]({"a": score, "b": score}).to_json()["precision"] == 0.8
    nothing = kitti_signs()["score_labels"](np.empty((0, 3)), signs, np.array([True, True, False]), tracks)
    assert nothing.to_json()["precision"] is None


def test_the_benchmark_says_where_its_data_should_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["kitti_signs.py", str(tmp_path)])
    assert kitti_signs()["main"]() == 1
    assert f"error: {tmp_path}/meta.json: no such file\nhint: " in capsys.readouterr().err


@pytest.mark.parametrize("sequence", ["00", "05", "07", "09"])
def test_real_tracks_project_into_their_boxes(sequence: str) -> None:
    """The residuals of the reference tracks are those that the reference itself states."""
    if not KITTI_SIGNS.is_dir():
        pytest.skip("the KITTI signs are not on this machine")
    dataset = kitti_signs()["import_sequence"](KITTI_SIGNS, sequence)
    tracks = pyarrow.csv.read_csv(KITTI_SIGNS / sequence / "reference_tracks.csv")
    rays = cast_rays(dataset)
    difference_px = []
    for x, y, z, stated_px in zip(*(tracks[c].to_pylist() for c in ("x", "y", "z", "median_reproj_px")), strict=True):
        a, b, c = np.einsum("nij,nj->in", rays.residual_from_world, [x, y, z] - rays.center_in_world_m)
        residual_px = np.where(c > 0.0, np.hypot(a, b) / c, np.inf)
        closest_px = np.full(len(dataset.images), np.inf)
        np.minimum.at(closest_px, rays.image_row, residual_px)
        difference_px.append(abs(np.median(closest_px[closest_px < 15.0]) - stated_px))
    assert np.median(difference_px) < 0.05


def test_a_camera_model_in_small_letters_is_told_to_be_in_capitals() -> None:
    with pytest.raises(SettingError) as refused:
        parse_camera("simple_radial 640 480 500 320 240 0")
    assert "expected a model in capitals first" in str(refused.value)
    assert refused.value.hint == "write SIMPLE_RADIAL"


IMPOSSIBLE: dict[str, tuple[Any, str]] = {
    "camera": ("PINHOLE 640 480 500", "camera 'PINHOLE 640 480 500'"),
    "pixel_center": (0.25, "pixel-center: expected 0 or 0.5"),
    "camera_height_m": (float("inf"), "camera-height: expected a finite number"),
    "crs": ("EPSG:1", "crs 'EPSG:1': there is no such system"),
    "vertical": ("EPSG:1", "vertical EPSG:1: there is no such system"),
    "up": ((0.0, 0.0, 0.0), "up: expected a direction"),
    "anchor": ((91.0, 0.0, 0.0), "anchor: expected latitude"),
    "max_rejected": (2.0, "max-rejected: expected a share"),
}


@pytest.mark.parametrize("name", sorted(READERS))
def test_options_are_looked_at_before_files(name: str, tmp_path: Path) -> None:
    """No file is there: what is refused was not read."""
    parameters = inspect.signature(READERS[name]).parameters
    needed = {
        key: tmp_path / "missing" if "Path" in str(each.annotation) else "PINHOLE 640 480 500 500 320 240"
        for key, each in parameters.items()
        if each.default is inspect.Parameter.empty
    }
    asked = IMPOSSIBLE.keys() & parameters.keys()
    assert "max_rejected" in asked
    for option in asked:
        value, said = IMPOSSIBLE[option]
        with pytest.raises(SettingError) as refused:
            READERS[name](**{**needed, option: value})
        assert said in str(refused.value)
