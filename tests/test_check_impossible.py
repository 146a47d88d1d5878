"""Boxes that no map takes are told, left out with a count, and none is put outside of its picture by a reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from check_faults import good_city, picture_size
from checking import convention_told
from valuemap.check import contest
from valuemap.check.boxes import ImpossibleBoxes, PictureSize, puts_boxes_outside
from valuemap.check.fault import View, with_detections
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.tables.write import write_table


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(21, passes_per_street=2)


def with_bad_rows(dataset: Dataset) -> Dataset:
    center, size = dataset.detections.center_px.copy(), dataset.detections.size_px.copy()
    center[5, 0], size[9, 0] = 7000.0, -3.0
    range_m = np.full(len(size), np.nan)
    range_m[12] = -1.0
    return with_detections(dataset, center_px=center, size_px=size, range_m=range_m)


def test_rows_that_a_map_refuses_are_left_out_with_a_count(city: Dataset, tmp_path: Path) -> None:
    given = with_bad_rows(city)
    finding = ImpossibleBoxes().find(View(given))
    assert finding is not None
    assert finding.figures["left_out"] == 3
    write_dataset(city, tmp_path / "given")
    write_table(given.detections, tmp_path / "given" / "detections.parquet")
    run = CliRunner().invoke(app, ["check", str(tmp_path / "given"), "--fix", str(tmp_path / "fixed")])
    assert run.exit_code == 3
    assert "3 detections are ones that no map takes" in run.stdout
    fixed = read_dataset(tmp_path / "fixed").detections.detection_id
    np.testing.assert_array_equal(fixed, np.delete(city.detections.detection_id, [5, 9, 12]))


def test_good_rows_are_possible(city: Dataset) -> None:
    assert ImpossibleBoxes().find(View(city)) is None


def test_of_rows_that_are_all_impossible_none_would_be_left(city: Dataset) -> None:
    finding = ImpossibleBoxes().find(View(with_detections(city, center_px=city.detections.center_px + 1e5)))
    assert finding is not None
    assert finding.fix is None


def test_an_error_after_a_fix_names_what_is_written(city: Dataset, tmp_path: Path) -> None:
    write_dataset(city, tmp_path / "given")
    outside = with_detections(city, center_px=city.detections.center_px + 1e5)
    write_table(outside.detections, tmp_path / "given" / "detections.parquet")
    run = CliRunner().invoke(app, ["check", str(tmp_path / "given"), "--fix", str(tmp_path / "fixed")])
    assert run.exit_code not in (0, 3)
    assert "fixed/detections.parquet" in "".join(run.output.split())
    assert not (tmp_path / "fixed").exists()


def test_a_reading_that_puts_boxes_outside_is_none(city: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    spoiled = picture_size(city)
    assert spoiled is not None
    finding = convention_told(spoiled)
    assert finding.fault == "picture_size"
    assert finding.fix is not None
    assert not puts_boxes_outside(spoiled, finding.fix)
    # One box of 2041 in a corner, that the sample need not have: what is as large is no longer possible.
    center = spoiled.detections.center_px.copy()
    center[0] = 0.99 * spoiled.cameras.width_px[0], 10.0
    cornered = with_detections(spoiled, center_px=center)
    verdict = contest.hold_contest(View(cornered), [PictureSize()])
    assert (
        verdict.finding is None or verdict.finding.fix is None or not puts_boxes_outside(cornered, verdict.finding.fix)
    )
    monkeypatch.setattr(contest, "puts_boxes_outside", lambda *_: False)
    found = contest.hold_contest(View(cornered), [PictureSize()]).finding
    assert found is not None
    assert found.fix is not None
    assert puts_boxes_outside(cornered, found.fix)
