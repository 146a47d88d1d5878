"""Functions that are called from Python say in one line which kind of thing they take, and which they were given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import valuemap
from small_dataset import map_of, small_dataset
from valuemap.check import examine
from valuemap.errors import SettingError

DATASET, MAP = small_dataset(), map_of([[4.0, 25.0, 5.0]])
HERE = Path("anywhere")
ANY: Any = valuemap


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ANY.build_map(None), "dataset: expected a Dataset or its folder, found NoneType"),
        (lambda: ANY.build_map(MAP), "dataset: expected a Dataset or its folder, found Map"),
        (lambda: ANY.build_map(DATASET, {"min_votes": 3}), "config: expected a MapConfig, found dict"),
        (lambda: ANY.build_map(DATASET, "robust"), "config: expected a MapConfig, found str"),
        (lambda: ANY.build_map(DATASET, threads="two"), "threads: expected 0 to 1024, found 'two'"),
        (lambda: ANY.build_map(DATASET, threads=True), "threads: expected 0 to 1024, found True"),
        (lambda: ANY.evaluate_map(MAP, None), "truth: expected a Dataset with truth, a Truth, or the folder or file"),
        (lambda: ANY.evaluate_map(MAP, np.zeros((3, 3))), "truth: expected a Dataset with truth, a Truth, or the fold"),
        (lambda: ANY.evaluate_map(DATASET, MAP), "map: expected a Map or its folder, found Dataset"),
        (lambda: ANY.evaluate_map(MAP, DATASET, images=3), "images: expected a Dataset or its folder, found int"),
        (lambda: ANY.read_dataset(None), "dataset: expected the folder of a dataset, found NoneType"),
        (lambda: ANY.read_dataset(3), "dataset: expected the folder of a dataset, found int"),
        (lambda: ANY.read_dataset(b"data"), "dataset: expected the folder of a dataset, found bytes"),
        (lambda: ANY.read_map(DATASET), "map: expected the folder of a map, found Dataset"),
        (lambda: ANY.write_dataset(MAP, HERE), "dataset: expected a Dataset, found Map"),
        (lambda: ANY.write_map(DATASET, HERE), "map: expected a Map, found Dataset"),
        (lambda: ANY.export_map(DATASET, HERE / "a.csv"), "map: expected a Map, found Dataset"),
        (lambda: ANY.export_map(MAP, HERE / "a.csv", dataset="data"), "dataset: expected a Dataset, found str"),
        (lambda: ANY.plot_map(DATASET), "map: expected a Map, found Dataset"),
        (lambda: ANY.draw_map(DATASET, None, None, HERE / "a.png"), "map: expected a Map, found Dataset"),
        (lambda: ANY.write_report(DATASET, HERE / "a.html"), "map: expected a Map, found Dataset"),
        (lambda: examine("data"), "dataset: expected a Dataset, found str"),  # type: ignore[arg-type]
        (lambda: examine(MAP), "dataset: expected a Dataset, found Map"),  # type: ignore[arg-type]
    ],
)
def test_another_kind_of_thing_is_one_line_with_a_hint(call: Callable[[], object], message: str) -> None:
    with pytest.raises(valuemap.ValuemapError) as refused:
        call()
    assert str(refused.value).startswith(message)
    assert refused.value.hint
    assert not HERE.exists()


def test_what_is_set_wrong_is_an_error_of_settings() -> None:
    with pytest.raises(SettingError):
        ANY.build_map(DATASET, {"min_votes": 3})


def test_a_map_is_no_dataset_and_a_dataset_no_map(tmp_path: Path) -> None:
    valuemap.write_map(MAP, tmp_path / "map")
    valuemap.write_dataset(DATASET, tmp_path / "data")
    with pytest.raises(valuemap.ValuemapError, match="map: is a map, not a dataset") as refused:
        valuemap.read_dataset(tmp_path / "map")
    assert refused.value.hint == "give the dataset that it was made from"
    with pytest.raises(valuemap.ValuemapError, match="data: is a dataset, not a map") as refused:
        valuemap.read_map(tmp_path / "data")
    assert refused.value.hint == f"valuemap map {tmp_path / 'data'} makes a map of it"
