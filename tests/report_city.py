"""A small simulated city with its map, for tests of what is shown of it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from valuemap import build_map
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import write_dataset
from valuemap.evidence import Evidence
from valuemap.map_folder import write_map
from valuemap.simulate import simulate


@cache
def city() -> Evidence:
    """Return the city: 16 lights, some passes, a map with all its evidence."""
    config = SimulationConfig(
        streets_north_south=2,
        streets_east_west=2,
        signalised_share=1.0,
        lights=16,
        frame_spacing_m=4.0,
        passes_per_street=3,
    )
    dataset = simulate(config, seed=3)
    return Evidence(build_map(dataset, MapConfig(correct_poses=0)), dataset)


def write_city(folder: Path, *, pictures: int = 0) -> tuple[Path, Path]:
    """Write the city and its map, with pictures of the first images that vote; return both folders."""
    evidence = city()
    data, result = folder / "dataset", folder / "map"
    write_dataset(evidence.dataset, data)
    write_map(evidence.result, result)
    for row in evidence.voters(int(evidence.result.labels.label_id[0])).image_row[:pictures]:
        path = data / "images" / evidence.image_name(int(row))
        path.parent.mkdir(parents=True, exist_ok=True)
        width, height = evidence.picture_size_px(np.array([row]))[0]
        Image.new("RGB", (int(width), int(height)), (40, 120, 200)).save(path)
    return data, result
