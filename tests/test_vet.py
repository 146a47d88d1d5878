"""Importing loses nothing without a word: what cannot be used is listed with its reason, and too much of it stops."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from small_dataset import small_dataset
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.errors import InputError, SettingError
from valuemap.readers.assemble import FoundBoxes, assemble
from valuemap.readers.boxes import NO_BOX
from valuemap.tables import Images
from valuemap.tables.table import table_to_arrow


def boxes(count: int = 300, **changes: Any) -> FoundBoxes:
    """Return boxes that are all fine and all different, in the images of `small_dataset` in turn."""
    fields: dict[str, Any] = {
        "image_row": np.arange(count) % 4,
        "class_names": ["light", "sign"] * (count // 2),
        "center_px": np.stack([np.linspace(10.0, 600.0, count), np.linspace(10.0, 400.0, count)], axis=1),
        "size_px": np.tile([10.0, 20.0], (count, 1)),
        "score": np.linspace(0.0, 1.0, count),
        "where": lambda row: f"boxes.json: annotations[{row}]",
    }
    return FoundBoxes(**{**fields, **changes})


def assembled(found: FoundBoxes, images: Images | None = None, **options: Any) -> Dataset:
    small = small_dataset()
    return assemble(
        name="small",
        cameras=small.cameras,
        images=images or small.images,
        detections=found,
        up=None,
        anchor=None,
        source="here",
        **options,
    ).whole()


def spoilt(values: Any, row: int, value: Any) -> Any:
    changed = values.copy()
    changed[row] = value
    return changed


def reasons(dataset: Dataset) -> list[tuple[str, str]]:
    assert dataset.rejected is not None
    return list(zip(dataset.rejected.place.to_pylist(), dataset.rejected.reason.texts(), strict=True))


def test_nothing_is_rejected_where_all_is_fine() -> None:
    dataset = assembled(boxes())
    assert dataset.rejected is None
    assert len(dataset.detections) == 300


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("image_row", -1, "its image is not among the images with a pose"),
        ("center_px", [np.nan, 5.0], "a number is missing or not finite"),
        ("size_px", [np.inf, 5.0], "a number is missing or not finite"),
        ("score", np.nan, "a number is missing or not finite"),
        ("size_px", [0.0, 5.0], "its width or height is not above 0"),
        ("size_px", [5.0, -1.0], "its width or height is not above 0"),
        ("size_px", [1e9, 5.0], "it is more than 2 times as large as its picture"),
        ("center_px", [-0.01, 5.0], "its centre lies outside its picture"),
        ("center_px", [5.0, 601.0], "its centre lies outside its picture"),
        ("score", -0.01, "its score is not from 0 to 1"),
        ("score", 97.0, "its score is not from 0 to 1"),
        ("class_names", "", "its class is missing, or not in the list of classes"),
    ],
)
def test_one_box_that_cannot_be_used_is_left_out_and_kept_beside(column: str, value: Any, reason: str) -> None:
    found = boxes(image_names=[f"name {i}" for i in range(300)])
    dataset = assembled(boxes(image_names=found.image_names, **{column: spoilt(getattr(found, column), 6, value)}))
    assert reasons(dataset) == [("boxes.json: annotations[6]", reason)]
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == ["name 6"]
    assert len(dataset.detections) == 299
    assert dataset.rejected.reason.texts() == [reason]


@pytest.mark.parametrize("column", ["range_m", "range_sigma_m"])
def test_ranges_may_be_missing_but_not_nothing_or_endless(column: Any) -> None:
    range_m = np.full(300, 30.0)
    range_m[:3] = [np.nan, 0.0, np.inf]
    dataset = assembled(boxes(300, **{column: range_m}))
    reason = "its range or a sigma is not above 0"
    assert reasons(dataset) == [("boxes.json: annotations[1]", reason), ("boxes.json: annotations[2]", reason)]


def test_points_have_no_size() -> None:
    assert assembled(boxes(size_px=np.zeros((300, 2)), are_points=True)).rejected is None


def test_the_limit_is_a_share_of_all_boxes() -> None:
    score = boxes().score
    assert len(assembled(boxes(score=np.append(score[:297], [2.0] * 3))).detections) == 297
    four = boxes(score=np.append(score[:296], [2.0] * 4))
    with pytest.raises(
        InputError, match=r"^here: 4 of 300 boxes cannot be used, more than 1 %: its score is"
    ) as caught:
        assembled(four)
    assert "(4, the first is boxes.json: annotations[296]: 'a/1.jpg', centre" in str(caught.value)
    assert "divide percentages by 100; or leave them out with --max-rejected 0.02" in caught.value.hint
    assert len(assembled(four, max_rejected=0.02).detections) == 296


def test_what_is_no_fault_of_the_boxes_makes_the_limit_no_wider() -> None:
    entry = np.where(np.arange(300) < 200, NO_BOX, 0)
    score = boxes().score
    wrong = boxes(entry=entry, score=np.append(score[:298], [2.0] * 2))
    with pytest.raises(InputError, match=r"more than 1 %: its score is") as caught:
        assembled(wrong)
    assert "--max-rejected 0.02" in caught.value.hint
    assert len(assembled(boxes(entry=entry, score=np.append(score[:299], [2.0]))).detections) == 99


def test_boxes_of_several_images_of_one_name_are_told_to_be_such() -> None:
    found = boxes(4, image_row=np.array([0, 1, 2, -1]), image_names=["a/1.jpg", "a/2.jpg", "b/1.jpg", "1.jpg"])
    with pytest.raises(InputError) as caught:
        assembled(found)
    assert "'1.jpg' may be any of 2 images, such as 'a/1.jpg' and 'b/1.jpg': give the folder too" in caught.value.hint


def test_an_import_of_nothing_stops_whatever_the_limit() -> None:
    with pytest.raises(InputError, match="300 of 300 boxes cannot be used, none is left"):
        assembled(boxes(score=np.full(300, 50.0)), max_rejected=1.0)


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_an_impossible_limit_is_refused(share: float) -> None:
    with pytest.raises(SettingError, match="max-rejected: expected a share from 0 to 1"):
        assembled(boxes(), max_rejected=share)


def test_every_box_twice_is_named() -> None:
    once = boxes(150)
    twice = boxes(
        image_row=np.tile(once.image_row, 2),
        class_names=[*once.class_names] * 2,
        center_px=np.tile(once.center_px, (2, 1)),
        size_px=np.tile(once.size_px, (2, 1)),
        score=np.tile(once.score, 2),
    )
    with pytest.raises(InputError, match="150 of 300 boxes cannot be used.*: the same box is there already"):
        assembled(twice)
    dataset = assembled(twice, max_rejected=0.5)
    assert table_to_arrow(dataset.detections).equals(table_to_arrow(assembled(once).detections))


def test_of_a_box_that_is_there_twice_the_surer_one_stays() -> None:
    found = boxes()
    center, score = spoilt(found.center_px, 8, found.center_px[4]), found.score
    assert reasons(assembled(boxes(center_px=center))) == [
        ("boxes.json: annotations[4]", "the same box is there already")
    ]
    ids = np.arange(300)[::-1]
    equal = spoilt(score, 8, score[4])
    dataset = assembled(boxes(center_px=center, score=equal, detection_id=ids))
    assert reasons(dataset)[0][0] == "boxes.json: annotations[4]"
    # Another image, class or size is another box.
    for change in (
        {"image_row": spoilt(found.image_row, 8, 1)},
        {"class_names": spoilt(found.class_names, 8, "other")},
        {"size_px": spoilt(found.size_px, 8, [10.0, 20.5])},
    ):
        assert assembled(boxes(center_px=center, **change)).rejected is None


def test_repeats_are_those_that_comparing_all_pairs_finds() -> None:
    random = np.random.default_rng(0)
    count = 400
    found = boxes(
        count,
        image_row=random.integers(0, 3, count),
        class_names=random.choice(["a", "b"], count).tolist(),
        center_px=random.integers(0, 6, (count, 2)).astype(np.float64),
        score=random.random(count),
    )
    keys = [
        (row, name, *center, *size)
        for row, name, center, size in zip(
            found.image_row.tolist(),
            found.class_names,
            found.center_px.tolist(),
            found.size_px.tolist(),
            strict=True,
        )
    ]
    best = {key: max(score for other, score in zip(keys, found.score, strict=True) if other == key) for key in keys}
    kept = [score for key, score in zip(keys, found.score, strict=True) if best[key] == score]
    dataset = assembled(found, max_rejected=1.0)
    assert len(kept) < count
    assert_array_equal(np.sort(dataset.detections.score), np.sort(kept))


def test_an_image_without_a_pose_takes_its_boxes_with_it_and_they_are_not_counted_again() -> None:
    small = small_dataset().images
    images = small.replace(cam_from_world_m=spoilt(small.cam_from_world_m, 1, np.nan))
    dataset = assembled(boxes(), images, max_rejected=0.25)
    assert dataset.images.image_id.tolist() == [10, 30, 40]
    assert dataset.rejected is not None
    left_out = Counter(zip(dataset.rejected.table.texts(), dataset.rejected.reason.texts(), strict=True))
    assert left_out == {
        ("images", "a number of its pose is missing or not finite"): 1,
        ("detections", "its image was left out"): 75,
    }
    assert reasons(dataset)[0][0] == "here: image 'a/2.jpg'"
    assert set(dataset.detections.image_id.tolist()) == {10, 30, 40}
    with pytest.raises(InputError, match="1 of 4 images cannot be used, more than 20 %"):
        assembled(boxes(), images, max_rejected=0.2)


def test_a_quaternion_that_is_none_is_no_pose() -> None:
    small = small_dataset().images
    images = Images(
        **{**vars(small), "cam_from_world_quat": spoilt(small.cam_from_world_quat, 3, [0.0, 0.0, 0.0, 0.0])}
    )
    dataset = assembled(boxes(), images, max_rejected=0.25, where_image=lambda row: f"poses.csv line {row + 2}")
    assert reasons(dataset)[0] == ("poses.csv line 5", "its quaternion is not of length 1, or its matrix no rotation")


def test_the_order_of_boxes_does_not_matter() -> None:
    found, order = boxes(), np.random.default_rng(1).permutation(300)
    shuffled = boxes(
        image_row=found.image_row[order],
        class_names=[found.class_names[i] for i in order],
        center_px=found.center_px[order],
        score=found.score[order],
    )
    assert table_to_arrow(assembled(shuffled).detections).equals(table_to_arrow(assembled(found).detections))


def test_what_was_left_out_is_written_and_read(tmp_path: Path) -> None:
    found = boxes()
    dataset = assembled(boxes(score=spoilt(found.score, 5, 7.0), class_names=spoilt(found.class_names, 5, "\udcff")))
    write_dataset(dataset, tmp_path / "city")
    again = read_dataset(tmp_path / "city")
    assert again.rejected is not None
    assert reasons(again) == reasons(dataset)
    assert again.rejected.class_name.texts() == ["\\udcff"]
    assert again.rejected.score.tolist() == [7.0]
