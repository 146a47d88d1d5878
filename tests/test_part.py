"""Datasets that are too large to be looked at whole: `check` and `report` look at whole places of them, and say so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from check_faults import FAULTS as INJECTED
from check_faults import good_city
from report_city import write_city
from valuemap import portions
from valuemap.check import examine, far_images
from valuemap.check.examine import Examination
from valuemap.check.fault import View
from valuemap.check.prospects import describe_prospects
from valuemap.cli import check as check_module
from valuemap.cli import report as report_module
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.errors import InputError
from valuemap.map_folder import read_map
from valuemap.tables import Detections as DetectionsTable
from valuemap.tables.read import read_table
from valuemap.tables.write import write_table
from valuemap.tiles import part
from valuemap.tiles.grid import Grid, smallest_squares


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dataset]:
    sparse = {"passes_per_street": 2, "frame_spacing_m": 4.0, "standing_interval_s": 2.0}
    dataset = good_city(1, streets_north_south=5, lights=40, streets_east_west=4, **sparse)
    folder = tmp_path_factory.mktemp("good") / "city"
    write_dataset(dataset, folder)
    return folder, read_dataset(folder)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be read whole, and a part be some places of a small city."""

    def never(*_: object, **__: object) -> None:
        raise AssertionError("the dataset is read whole")

    for module in (check_module, report_module):
        monkeypatch.setattr(module, "read_dataset", never)
    monkeypatch.setattr(portions, "LARGEST_IN_MEMORY", 0)
    monkeypatch.setattr(part, "LARGEST_PART", 900)
    monkeypatch.setattr(portions, "ROWS", 200)


def none_far(place_m: Any) -> Any:
    return np.zeros(len(place_m), np.bool_)


@pytest.mark.usefixtures("small")
def test_a_part_is_whole_places_and_counts_the_rest(good: tuple[Path, Dataset]) -> None:
    folder, whole = good
    found = part.read_part(folder, also=none_far)
    images, detections = whole.images, whole.detections
    assert 0 < len(found.dataset.detections) < 0.7 * len(detections)
    is_in = np.isin(images.image_id, found.dataset.images.image_id)
    grid = Grid.of(whole.frame, 60.0)
    square = smallest_squares(grid, grid.images_on_ground(images))
    assert not {tuple(each) for each in square[is_in].tolist()} & {tuple(each) for each in square[~is_in].tolist()}
    of_part = np.isin(detections.image_id, found.dataset.images.image_id)
    assert found.dataset.detections.detection_id.tolist() == detections.detection_id[of_part].tolist()
    assert found.dataset.images.name.to_pylist() == images.take(is_in).name.to_pylist()
    assert (found.images, found.detections) == (len(images), len(detections))
    assert found.images_without_detections == len(images) - len(np.unique(detections.image_id))
    # Some passes are whole, whatever places they are in.
    names = set(found.drives.pass_id.texts())
    assert 0 < len(names) < found.passes == len(set(images.pass_id.texts()))
    assert len(found.drives) == sum(name in names for name in images.pass_id.texts())


@pytest.mark.usefixtures("small")
def test_check_looks_at_a_part_of_a_large_dataset_and_says_so(
    good: tuple[Path, Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, whole = good
    found: list[Examination] = []

    def once(*given: Any, **more: Any) -> Examination:
        found.extend([] if found else [examine(*given, **more)])
        return found[0]

    monkeypatch.setattr("valuemap.check.examine", once)
    run = CliRunner().invoke(app, ["check", str(folder), "--json"])
    assert run.exit_code == 0, run.output
    told, of_whole = json.loads(run.stdout), describe_prospects(View(whole))
    assert told["findings"] == []
    assert told["looked_at"]["of_detections"] == len(whole.detections)
    assert told["looked_at"]["detections"] < 0.7 * len(whole.detections)
    for name in ("images", "detections", "images_without_detections", "scores", "passes"):
        assert told["prospects"][name] == of_whole[name]
    assert "in whole places spread over all of it" in CliRunner().invoke(app, ["check", str(folder)]).stdout


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", ["quaternion_order", "repeated_boxes", "far_images", "passes_no_drives"])
def test_faults_show_in_a_part(name: str, good: tuple[Path, Dataset], tmp_path: Path) -> None:
    spoiled = INJECTED[name].spoil(good[1])
    assert spoiled is not None
    write_dataset(spoiled, tmp_path / "spoiled")
    found = part.read_part(tmp_path / "spoiled", also=far_images)
    assert len(found.dataset.images) < 0.7 * found.images
    assert [each.fault for each in examine(found.dataset, drives=found.drives).findings] == [name]


@pytest.mark.usefixtures("small")
def test_rows_that_are_not_in_the_part_are_checked_too(good: tuple[Path, Dataset], tmp_path: Path) -> None:
    write_dataset(good[1], tmp_path / "city")
    in_part = part.read_part(tmp_path / "city", also=none_far).dataset.detections.detection_id
    file = tmp_path / "city" / "detections.parquet"
    detections = read_table(DetectionsTable, file)
    outside = np.flatnonzero(~np.isin(detections.detection_id, in_part))[0]
    image_id = detections.image_id.copy()
    image_id[outside] = 10**6
    write_table(detections.replace(image_id=image_id), file)
    with pytest.raises(InputError, match="1000000"):
        part.read_part(tmp_path / "city", also=none_far)


@pytest.mark.usefixtures("small")
def test_a_report_shows_a_part_of_a_large_map_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, result = write_city(tmp_path)
    labels = len(read_map(result).labels)
    monkeypatch.setattr("valuemap.report.write._figures", lambda *_: [])  # Drawn in other tests.
    monkeypatch.setattr(part, "LARGEST_PART", 300)
    some, dataset = part.part_of_map(read_map(result), data)
    assert 0 < len(some.labels) < labels
    assert len(dataset.images) < len(read_dataset(data).images)
    run = CliRunner().invoke(app, ["report", str(result), "--out", str(tmp_path / "page.html"), "--dataset", str(data)])
    assert run.exit_code == 0, run.output
    assert f"{len(some.labels)} of {labels} labels are shown" in (tmp_path / "page.html").read_text(encoding="utf-8")
