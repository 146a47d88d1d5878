"""Small random scenes with known truth, for the tests of the core."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from literal import Floats, Pinhole, Sighting
from valuemap.dataset import Dataset, Frame
from valuemap.tables import Cameras, Categories, Detections, Images

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0


@dataclass(frozen=True)
class Scene:
    """Cameras, sightings (ordered by image) and the objects that they show."""

    cameras: list[Pinhole]
    sightings: list[Sighting]
    objects: Floats


def random_scene(
    seed: int,
    *,
    images: int = 10,
    objects: int = 3,
    clutter: int = 6,
    noise_px: float = 1.0,
    recall: float = 0.85,
    classes: tuple[str, ...] = ("light",),
) -> Scene:
    """Drive along x past objects on both sides, z up; two objects are 0.5 m apart, so that gates overlap."""
    random = np.random.default_rng(seed)
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    beside = random.choice([-1, 1], objects) * random.uniform(3, 12, objects)
    places = np.column_stack([random.uniform(20, 60, objects), beside, random.uniform(3, 6, objects)])
    if objects > 1:
        places[1] = places[0] + [0.0, 0.5, 0.0]
    object_class = [classes[i % len(classes)] for i in range(objects)]
    cameras, sightings = [], []
    for i in range(images):
        heading, pitch = random.normal(0.0, 0.15), random.normal(0.0, 0.03)
        # Camera axes: x right, y down, z forward, for a camera that looks along world x.
        level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
        rotation = Rotation.from_euler("xy", [pitch, heading]).as_matrix() @ level
        center = np.array([40.0 * i / images, random.normal(0.0, 1.5), 1.6])
        camera = Pinhole(intrinsics, rotation, -rotation @ center)
        cameras.append(camera)
        for place, class_name in zip(places, object_class, strict=True):
            pixel, depth = camera.project(place)
            inside = depth > 1.0 and 0 <= pixel[0] < WIDTH and 0 <= pixel[1] < HEIGHT
            if inside and random.random() < recall:
                sightings.append(Sighting(i, class_name, pixel + random.normal(0.0, noise_px, 2)))
    for _ in range(clutter):
        pixel = random.uniform([0.0, 0.0], [WIDTH, HEIGHT])
        sightings.append(Sighting(int(random.integers(images)), classes[int(random.integers(len(classes)))], pixel))
    return Scene(cameras, sorted(sightings, key=lambda s: s.image), places)


def as_dataset(scene: Scene, *, passes: list[str] | None = None) -> Dataset:
    """Turn a scene into a dataset: image_id and detection_id are 10 times the index, box sizes 10 x 20 px."""
    count = len(scene.cameras)
    quaternion = np.array([Rotation.from_matrix(c.rotation).as_quat(scalar_first=True) for c in scene.cameras])
    return Dataset(
        name="scene",
        frame=Frame(),
        cameras=Cameras(
            camera_id=np.array([7]),
            model=Categories.from_texts(["PINHOLE"]),
            width_px=np.array([WIDTH]),
            height_px=np.array([HEIGHT]),
            params=[np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])],
        ),
        images=Images(
            image_id=10 * np.arange(count),
            name=pa.array([f"{i:03d}.jpg" for i in range(count)]),
            camera_id=np.full(count, 7),
            cam_from_world_quat=quaternion,
            cam_from_world_m=np.array([c.translation for c in scene.cameras]),
            pass_id=Categories.from_texts(passes or ["one"] * count),
        ),
        detections=Detections(
            detection_id=10 * np.arange(len(scene.sightings)),
            image_id=10 * np.array([s.image for s in scene.sightings]),
            class_name=Categories.from_texts([s.class_name for s in scene.sightings]),
            center_px=np.array([s.pixel for s in scene.sightings]),
            size_px=np.tile([10.0, 20.0], (len(scene.sightings), 1)),
            score=np.ones(len(scene.sightings)),
        ),
    )
