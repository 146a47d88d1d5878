"""Cities larger than memory: districts side by side, each simulated on its own and done with before the next."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc

from valuemap.cameras import rotation_matrices
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset
from valuemap.progress import Progress, silent
from valuemap.simulate.simulation import record_city
from valuemap.simulate.streams import random_stream
from valuemap.tables import Categories


def simulate_districts(
    config: SimulationConfig, *, seed: int, name: str = "simulated", progress: Progress = silent
) -> Iterator[Dataset]:
    """Yield the districts of a city as pieces of one dataset, for `write_dataset_in_pieces`.

    The first is the city that `simulate` returns for the same seed; the others have seeds of their own. They stand
    side by side in a square, a block apart. Passes of each are named after it. Raises as `record_city`.
    """
    alone = replace(config, districts=1)
    across = math.ceil(math.sqrt(config.districts))
    first_id = np.zeros(3, np.int64)  # Of images, detections and objects.
    for number in range(config.districts):

        def in_district(what: str, done: int, total: int, number: int = number) -> None:
            progress(f"district {number + 1} of {config.districts}: {what}", done, total)

        of_district = seed if number == 0 else int(random_stream(seed, "district", number).integers(2**31))
        city = record_city(alone, seed=of_district, name=name, progress=in_district).dataset
        assert city.truth is not None
        east_m = (number % across) * config.streets_north_south * config.block_east_m
        north_m = (number // across) * config.streets_east_west * config.block_north_m
        yield _placed(city, f"district-{number}/", (east_m, north_m), *first_id.tolist())
        first_id += [len(city.images), len(city.detections), len(city.truth)]


def _placed(
    city: Dataset, prefix: str, east_north_m: tuple[float, float], image: int, detection: int, thing: int
) -> Dataset:
    """Return a city moved on the ground, with ids that begin with `image`, `detection` and `thing`."""
    images, detections, truth, shown = city.images, city.detections, city.truth, city.truth_detections
    assert truth is not None
    assert shown is not None
    away_m = np.array([*east_north_m, 0.0])
    passes = images.pass_id
    return replace(
        city,
        images=images.replace(
            image_id=images.image_id + image,
            name=pc.binary_join_element_wise(prefix, images.name, ""),
            cam_from_world_m=images.cam_from_world_m - rotation_matrices(images) @ away_m,
            pass_id=Categories(passes.codes, tuple(f"{prefix}{each}" for each in passes.names)),
        ),
        detections=detections.replace(
            detection_id=detections.detection_id + detection, image_id=detections.image_id + image
        ),
        truth=truth.replace(object_id=truth.object_id + thing, position_in_world_m=truth.position_in_world_m + away_m),
        truth_detections=shown.replace(detection_id=shown.detection_id + detection, object_id=shown.object_id + thing),
    )
