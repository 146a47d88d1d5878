"""What a label rests on: votes, images that should have seen it, rays past a place, and pieces of pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from report_city import city
from small_dataset import map_of, small_dataset
from valuemap.dataset import write_dataset
from valuemap.errors import InputError
from valuemap.evidence import Evidence, cut_out, find_dataset, picture_file, pictures_there


def test_voters_are_those_of_the_map_and_projections_explain_the_residuals() -> None:
    evidence = city()
    assert len(evidence.result.labels) >= 5
    for row, label_id in enumerate(evidence.result.labels.label_id):
        voters = evidence.voters(label_id)
        assert len(voters) == evidence.result.labels.votes[row]
        assert_allclose(np.linalg.norm(voters.projected_px - voters.box_px, axis=1), voters.residual_px, atol=1e-6)
        assert np.all(np.diff(voters.pass_number) >= 0)


def test_voters_and_misses_together_are_the_images_expected() -> None:
    evidence = city()
    labels = evidence.result.labels
    assert labels.expected is not None
    counted = [len(evidence.voters(i)) + len(evidence.misses(i)) for i in labels.label_id]
    assert_array_equal(counted, labels.expected)
    assert sum(counted) > sum(labels.votes)  # Some are misses.


def test_a_miss_says_whose_the_nearest_detection_is() -> None:
    evidence = city()
    for label_id in evidence.result.labels.label_id:
        misses = evidence.misses(label_id)
        assert not np.isin(misses.image_row, evidence.voters(label_id).image_row).any()
        has = misses.nearest_row >= 0
        apart = evidence.dataset.detections.center_px[misses.nearest_row[has]] - misses.projected_px[has]
        assert_allclose(np.linalg.norm(apart, axis=1), misses.nearest_px[has])
        assert_array_equal(misses.nearest_label[has], evidence.label_of_detection[misses.nearest_row[has]])


def test_rays_past_a_label_are_its_votes_and_past_an_empty_place_there_are_none() -> None:
    evidence = city()
    labels = evidence.result.labels
    row = int(np.argmax(labels.votes))
    passing = evidence.rays_past(labels.position_in_world_m[row], radius_m=1.0)
    voters = evidence.voters(int(labels.label_id[row]))
    near = voters.detection_row[voters.distance_m < 30.0]
    assert np.isin(near, passing.detection_row).mean() > 0.9
    assert np.all(np.diff(passing.miss_m) >= 0.0)
    assert np.all(passing.miss_m <= 1.0)
    assert len(evidence.rays_past(np.array([5000.0, 0.0, 0.0]), radius_m=2.0)) == 0


def test_votes_of_another_dataset_are_refused() -> None:
    with pytest.raises(InputError, match=r"votes.parquet row 0: detection_id 0 is not in the dataset small"):
        Evidence(map_of([[0.0, 20.0, 3.0]], residual_px=[1.0]), small_dataset())
    swapped = city().result.votes.image_id[::-1].copy()
    result = dataclasses.replace(city().result, votes=city().result.votes.replace(image_id=swapped))
    with pytest.raises(InputError, match=r"votes.parquet row 0: detection_id \d+ is of another image in the dataset"):
        Evidence(result, city().dataset)
    with pytest.raises(InputError, match="no label 99"):
        city().voters(99)


def test_a_label_without_votes_has_no_misses() -> None:
    evidence = Evidence(map_of([[4.0, 25.0, 5.0]]), small_dataset())
    assert len(evidence.voters(0)) == len(evidence.misses(0)) == 0


def test_all_images_that_picture_a_place_look_at_it() -> None:
    evidence = Evidence(map_of([]), small_dataset())
    looks = evidence.looks_at(np.array([4.0, 25.0, 5.0]))
    assert_array_equal(looks.image_row, [0, 1, 2, 3])
    assert len(evidence.looks_at(np.array([4.0, -25.0, 5.0]))) == 0  # Behind all cameras.
    assert len(evidence.looks_at(np.array([4.0, 100.0, 5.0]))) == 0  # Beyond max_range_m.


# Pictures.


def gradient(path: Path) -> Path:
    pixels = np.zeros((100, 200, 3), np.uint8)
    pixels[:, :, 0], pixels[:, :, 1] = np.arange(200), np.arange(100)[:, None]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def test_a_piece_is_where_it_says(tmp_path: Path) -> None:
    cut = cut_out(gradient(tmp_path / "a.png"), np.array([60.5, 40.5]), 20.0, 20)
    assert cut.shape == (20, 20, 3)
    assert_allclose(cut[10, 10, :2], [60, 40], atol=1)
    enlarged = cut_out(tmp_path / "a.png", np.array([60.0, 40.0]), 20.0, 80)
    assert_allclose(enlarged[40, 40, :2], [60, 40], atol=1)
    beyond = cut_out(tmp_path / "a.png", np.array([0.0, 0.0]), 20.0, 20, empty=(1, 2, 3))
    assert_array_equal(beyond[2, 2], [1, 2, 3])


def test_a_large_jpeg_shrunk_is_where_it_says(tmp_path: Path) -> None:
    x, _ = np.meshgrid(np.arange(1600), np.arange(1200))
    Image.fromarray((x // 8).astype(np.uint8)).convert("RGB").save(tmp_path / "a.jpg", quality=95)
    cut = cut_out(tmp_path / "a.jpg", np.array([800.0, 600.0]), 800.0, 50)
    assert_allclose(cut[25, [0, 25, 49], 0], [50, 100, 149], atol=3)


@pytest.mark.parametrize("content", [None, b"", b"no picture", b"\xff\xd8\xff\xe0cut"])
def test_without_a_picture_there_is_an_empty_frame(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "a.jpg").write_bytes(content)
    cut = cut_out(tmp_path / "a.jpg" if content is not None else None, np.array([5.0, 5.0]), 10.0, 8)
    assert len(np.unique(cut.reshape(-1, 3), axis=0)) == 1


def test_no_name_leads_out_of_the_folder(tmp_path: Path) -> None:
    inside, secret = gradient(tmp_path / "images" / "a" / "1.png"), gradient(tmp_path / "secret.png")
    (tmp_path / "images" / "link.png").symlink_to(secret)
    folder = tmp_path / "images"
    assert picture_file(folder, "a/1.png") == inside.resolve()
    for name in ("../secret.png", "a/../../secret.png", str(secret), "link.png", "none.png", "", "\0", "a" * 5000):
        assert picture_file(folder, name) is None, name
    assert picture_file(None, "a/1.png") is None


def test_the_dataset_of_a_map_is_found(tmp_path: Path) -> None:
    assert find_dataset(tmp_path / "map", {}) is None
    write_dataset(small_dataset(), tmp_path / "dataset")
    write_dataset(small_dataset(), tmp_path / "elsewhere")
    assert find_dataset(tmp_path / "map", {}) == tmp_path / "dataset"
    assert find_dataset(tmp_path / "map", {"dataset_folder": "../elsewhere"}) == tmp_path / "elsewhere"
    assert find_dataset(tmp_path / "map", {}, tmp_path / "given") == tmp_path / "given"


def test_pictures_are_there_where_one_of_them_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    (folder / "a").mkdir(parents=True)
    for path in (folder / "a" / "1.jpg", folder / "2.jpg", tmp_path / "secret.jpg"):
        path.write_bytes(b"")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "3.jpg").write_bytes(b"")
    (folder / "inside.jpg").symlink_to(folder / "2.jpg")
    (folder / "outside.jpg").symlink_to(tmp_path / "secret.jpg")
    (folder / "out").symlink_to(tmp_path / "elsewhere")
    names = ["a/1.jpg", "2.jpg", "a/../2.jpg", "inside.jpg", "./2.jpg", "outside.jpg", "out/3.jpg", "../secret.jpg"]
    names += [str(tmp_path / "secret.jpg"), "missing.jpg", "x" * 5000, "a\0b", "no/folder.jpg", "a", "a/..", ""]
    found = pictures_there(folder, names)
    assert found == [picture_file(folder, name) is not None for name in names]
    assert found == [True] * 5 + [False] * (len(names) - 5)
    assert pictures_there(None, names) == [False] * len(names)
