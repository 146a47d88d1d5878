"""Maps, tables and settings as people meet them in a notebook."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_array_equal

import valuemap
from report_city import city
from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.config import MapConfig, VoteConfig
from valuemap.dataset import Dataset, Frame
from valuemap.errors import InputError, SettingError
from valuemap.readers import READERS
from valuemap.tables import Categories


def test_importing_valuemap_imports_nothing_slow() -> None:
    slow = ["numpy", "pyarrow", "pycolmap", "pandas", "geopandas", "matplotlib", "scipy", "cv2", "onnxruntime", "rich"]
    slow += ["pydantic", "typer"]
    code = f"import valuemap, sys; print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_is_meant_for_users_is_there_and_no_more() -> None:
    assert dir(valuemap) == sorted(valuemap.__all__)
    for name in valuemap.__all__:
        assert getattr(valuemap, name) is not None
    assert valuemap.__version__ == version("valuemap")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        valuemap.nothing  # noqa: B018
    assert (Path(valuemap.__file__).parent / "py.typed").is_file()


def test_rows_of_a_table_are_taken_by_mask_indices_and_slice() -> None:
    labels = map_of(np.arange(12.0).reshape(4, 3), ["a", "b", "a", "c"]).labels
    assert {"take", "label_id", "to_pandas"} <= set(dir(labels))
    assert not {"KEY", "MAY_BE_EMPTY"} & set(dir(labels))
    mask = labels.position_in_world_m[:, 0] > 2.0
    assert_array_equal(labels[mask].label_id, [1, 2, 3])
    assert_array_equal(labels[[0, 3]].label_id, [0, 3])
    assert_array_equal(labels[1:3].label_id, [1, 2])
    assert labels[mask].class_name.texts() == ["b", "a", "c"]
    assert len(labels[[]]) == 0
    with pytest.raises(TypeError, match=r"take \[2:3\] of it"):
        labels[2]  # type: ignore[index]
    with pytest.raises(IndexError, match="a mask of 2 rows for a table of 4"):
        labels[np.array([True, False])]


def test_a_map_is_short_as_text_and_a_picture_in_a_notebook() -> None:
    result = map_of([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], ["<b>", "sign"])
    assert repr(result) == "Map(2 labels of 2 classes, 0 votes)"
    assert repr(result).replace("2 classes", "1 class") == repr(map_of([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert repr(result.labels).startswith("Labels(2 rows: label_id, class, x, y, z, ")
    assert repr(result.labels.class_name) == "Categories(2 rows of '<b>', 'sign')"
    assert "2 true objects" in repr(small_dataset())
    assert len(repr(city().dataset)) < 120
    shown = result._repr_html_()
    assert shown.count("<img ") == 1
    assert "data:image/png;base64," in shown
    table = result.labels._repr_html_()
    assert "&lt;b&gt;" in table
    assert "<b>" not in table
    assert isinstance(result.plot(), Figure)
    assert isinstance(city().result.plot(city().dataset), Figure)


def test_a_map_becomes_data_frames() -> None:
    places = np.array([[-0.14, 51.5, 36.0]])
    result = map_of([[1.0, 2.0, 3.0]], frame=Frame(anchor=ANCHOR), lon_lat_height=places)
    frame = result.to_pandas()
    assert frame.loc[0, "class"] == "light"
    assert frame.loc[0, "y"] == 2.0
    points = result.to_geopandas()
    assert points.crs == "EPSG:4979"
    assert points.geometry.x[0] == -0.14
    with pytest.raises(InputError, match="not geo-referenced"):
        map_of([[1.0, 2.0, 3.0]]).to_geopandas()
    assert len(city().dataset.images.to_pandas()) == len(city().dataset.images)


def test_single_settings_are_given_by_name() -> None:
    config = MapConfig(max_range_m=80.0, min_votes=4, min_existence=0.7)
    assert config == MapConfig().with_settings(["max_range_m=80", "min_votes=4", "min_existence=0.7"])
    assert MapConfig("paper", vote=VoteConfig(min_votes=5), max_range_m=80).vote == VoteConfig(
        min_votes=5, max_range_m=80
    )
    assert replace(config, method="paper").vote == config.vote
    assert MapConfig() == MapConfig()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_rang_m": 80}, "there is no setting named 'max_rang_m'"),
        ({"max_range_m": -1.0}, "max_range_m: expected at least 1e-06"),
        ({"max_range_m": "80"}, "max_range_m: expected a number"),
        ({"max_range_m": True}, "max_range_m: expected a number"),
        ({"min_votes": 2.5}, "min_votes: expected a whole number"),
        ({"min_votes": None}, "min_votes: expected a whole number"),
        ({"min_range_m": 90.0}, "must be less than max_range_m"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        MapConfig(**settings)


def changed(**columns: Any) -> Dataset:
    dataset = small_dataset()
    return replace(dataset, detections=dataset.detections.replace(**columns))


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        (changed(score=np.array([0.5, 0.5])), "small: detections: score: expected 5 rows, found 2"),
        (
            changed(center_px=np.zeros((5, 3))),
            r"numbers of shape \(5, 2\), found float64 of \(5, 3\)",
        ),
        (changed(center_px=np.full((5, 2), np.nan)), "small: detections row 0: center_px: expected finite numbers"),
        (changed(image_id=np.array([1.0, 2, 3, 4, 5])), "image_id: expected whole numbers"),
        (
            changed(detection_id=np.array([5, 4, 3, 2, 1])),
            "row 1: detection_id: expected ascending unique ids",
        ),
        (changed(class_name=["light"] * 5), "class_name: expected Categories, found list"),
        (changed(score=None), "score: expected values, found None"),
        (changed(image_id=np.array([10, 20, 30, 30, 77])), "expected an id that is in images.parquet, found 77"),
    ],
)
def test_a_dataset_made_by_hand_is_checked(dataset: Dataset, message: str) -> None:
    with pytest.raises(InputError, match=message):
        valuemap.build_map(dataset)


def test_a_good_dataset_made_by_hand_is_mapped() -> None:
    valuemap.build_map(replace(small_dataset(), truth_detections=None))
    made, paper = city().dataset, MapConfig("paper")
    long = made.images.replace(cam_from_world_quat=made.images.cam_from_world_quat * (1.0 + 1e-5))
    given, scaled = (valuemap.build_map(each, paper) for each in (made, replace(made, images=long)))
    assert len(given.votes) == len(scaled.votes) > 0


def test_readers_take_texts(tmp_path: Path) -> None:
    for reader in READERS.values():
        assert reader.__doc__
    with pytest.raises(InputError, match="nothing-here"):
        READERS["colmap"](str(tmp_path / "nothing-here"))


def test_categories_are_told_short() -> None:
    assert repr(Categories.from_texts(list("abcdefg"))) == "Categories(7 rows of 'a', 'b', 'c', 'd', 'e', ...)"
