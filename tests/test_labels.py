"""Labelled pictures: boxes come in right from every format, and what is broken is named and left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from valuemap.detect.labels import read_labels
from valuemap.errors import InputError

DETECTOR = Path(__file__).parents[2] / "shared" / "data" / "detector"


def write_picture(path: Path, *, width: int = 200, height: int = 100, orientation: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", (width, height)).save(path, exif=exif)


def write_text(path: Path, *lines: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_bosch_boxes_are_centres_and_sizes_in_px(tmp_path: Path) -> None:
    path = write_text(
        tmp_path / "train.yaml",
        "- boxes:",
        "  - {label: Red, occluded: false, x_max: 12.0, x_min: 8.0, y_max: 30.5, y_min: 20.5}",
        "  path: ./rgb/a.png",
        "- boxes: []",
        "  path: ./rgb/b.png",
    )
    labels = read_labels(f"bosch:{path}")
    first, second = labels.pictures
    assert first.path == tmp_path / "rgb" / "a.png"
    assert first.boxes_px.tolist() == [[10.0, 25.5, 4.0, 10.0]]
    assert first.classes == ("Red",)
    assert (second.boxes_px.shape, second.classes) == ((0, 4), ())
    assert (labels.class_names, labels.boxes, labels.skipped) == (("Red",), 1, ())


def test_bosch_finds_pictures_that_moved_from_an_absolute_path(tmp_path: Path) -> None:
    write_picture(tmp_path / "rgb" / "test" / "7.png")
    path = write_text(tmp_path / "test.yaml", "- {boxes: [], path: /nowhere/bosch/rgb/test/7.png}")
    assert read_labels(f"bosch:{path}").pictures[0].path == tmp_path / "rgb" / "test" / "7.png"


def test_broken_bosch_labels_are_named_and_the_others_stay(tmp_path: Path) -> None:
    good = "{label: Red, x_min: 1, x_max: 3, y_min: 1, y_max: 5}"
    path = write_text(
        tmp_path / "train.yaml",
        f"- {{path: a.png, boxes: [{good}, {{label: Red, x_min: 1, x_max: 3, y_min: 1}}]}}",
        f"- {{path: b.png, boxes: [{{label: Red, x_min: 3, x_max: 1, y_min: 1, y_max: 5}}, {good}]}}",
        "- {path: c.png, boxes: [{label: Red, x_min: .nan, x_max: 1, y_min: 1, y_max: 5}]}",
        "- {boxes: []}",
        "- 7",
        "- {path: d.png, boxes: none}",
    )
    labels = read_labels(f"bosch:{path}")
    assert [picture.path.name for picture in labels.pictures] == ["a.png", "b.png", "c.png"]
    assert labels.boxes == 2
    assert [line.removeprefix(f"{path} ").partition(":")[0] for line in labels.skipped] == [
        "entry 0 box 1",
        "entry 1 box 0",
        "entry 2 box 0",
        "entry 3",
        "entry 4",
        "entry 5",
    ]


def test_the_whole_bosch_file_loads() -> None:
    path = DETECTOR / "bosch" / "train.yaml"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    labels = read_labels(f"bosch:{path}")
    assert (len(labels.pictures), labels.boxes, labels.skipped) == (5093, 10756, ())


def test_yolo_boxes_and_polygons_become_boxes_in_px(tmp_path: Path) -> None:
    write_picture(tmp_path / "train" / "images" / "a.jpg")
    write_text(
        tmp_path / "train" / "labels" / "a.txt",
        "0 0.5 0.5 0.1 0.2",
        "1 0.5 0.5 0.1 0.2 0.9",
        "",
        "1 0.1 0.2 0.3 0.2 0.2 0.8",
    )
    write_picture(tmp_path / "valid" / "images" / "b.jpg")
    write_text(tmp_path / "data.yaml", "names: [green, red]")
    first, second = read_labels(f"yolo:{tmp_path}").pictures
    expected = [[100.0, 50.0, 20.0, 20.0], [100.0, 50.0, 20.0, 20.0], [40.0, 50.0, 40.0, 60.0]]
    assert np.allclose(first.boxes_px, expected)
    assert (first.classes, first.split) == (("green", "red", "red"), "train")
    assert (second.classes, second.split) == ((), "val")


@pytest.mark.parametrize(
    ("picture", "text"),
    [("images/train/a.jpg", "labels/train/a.txt"), ("images/a.jpg", "labels/a.txt"), ("a.jpg", "a.txt")],
)
def test_yolo_folders_of_every_layout(tmp_path: Path, picture: str, text: str) -> None:
    write_picture(tmp_path / picture)
    write_text(tmp_path / text, "3 0.5 0.5 0.1 0.1")
    assert read_labels(f"yolo:{tmp_path}").pictures[0].classes == ("class-3",)


def test_yolo_of_the_folder_of_pictures_itself(tmp_path: Path) -> None:
    write_picture(tmp_path / "images" / "a.jpg")
    write_text(tmp_path / "labels" / "a.txt", "0 0.5 0.5 0.1 0.1")
    assert read_labels(f"yolo:{tmp_path / 'images'}").boxes == 1


@pytest.mark.parametrize("names", ["names: {0: zero, 2: two}", "names: [zero, one, two]"])
def test_yolo_names_as_list_or_by_number(tmp_path: Path, names: str) -> None:
    write_picture(tmp_path / "a.png")
    write_text(tmp_path / "a.txt", "2 0.5 0.5 0.1 0.1", "0 0.5 0.5 0.1 0.1")
    write_text(tmp_path / "data.yaml", names)
    assert read_labels(f"yolo:{tmp_path}").pictures[0].classes == ("two", "zero")


@pytest.mark.parametrize(
    ("names", "place"), [("data.yaml", "valid/images"), ("dataset.yml", "valid"), ("obj.names", "valid")]
)
def test_yolo_names_stand_above_a_part_of_a_dataset(tmp_path: Path, names: str, place: str) -> None:
    write_picture(tmp_path / "valid" / "images" / "a.png")
    write_text(tmp_path / "valid" / "labels" / "a.txt", "1 0.5 0.5 0.1 0.1")
    write_text(tmp_path / names, *(["zero", "one"] if names == "obj.names" else ["names: [zero, one]"]))
    assert read_labels(f"yolo:{tmp_path / place}").class_names == ("one",)


def test_key_points_of_yolo_are_no_corners_of_a_polygon(tmp_path: Path) -> None:
    """Two key points of two numbers make eight with the box, as four corners would."""
    write_picture(tmp_path / "a.jpg")
    write_text(tmp_path / "a.txt", "0 0.5 0.5 0.1 0.2 0.1 0.1 0.9 0.9")
    write_text(tmp_path / "data.yaml", "names: [light]", "kpt_shape: [2, 2]")
    assert np.allclose(read_labels(f"yolo:{tmp_path}").pictures[0].boxes_px, [[100.0, 50.0, 20.0, 20.0]])


def test_yolo_labels_may_begin_with_a_mark_of_an_editor(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg")
    write_text(tmp_path / "a.txt", "\ufeff0 0.5 0.5 0.1 0.2")
    assert read_labels(f"yolo:{tmp_path}").class_names == ("class-0",)


def test_yolo_names_line_by_line(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png")
    write_text(tmp_path / "a.txt", "1 0.5 0.5 0.1 0.1")
    write_text(tmp_path / "classes.txt", "zero", "one")
    assert read_labels(f"yolo:{tmp_path}").class_names == ("one",)


def test_yolo_shares_are_of_the_picture_as_it_is_shown(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg", width=200, height=100, orientation=6)
    write_text(tmp_path / "a.txt", "0 0.5 0.5 0.1 0.1")
    assert np.allclose(read_labels(f"yolo:{tmp_path}").pictures[0].boxes_px, [[50.0, 100.0, 10.0, 20.0]])


def test_broken_yolo_lines_and_pictures_are_named_and_the_others_stay(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg")
    text = write_text(
        tmp_path / "a.txt", "0 0.5", "x 0.5 0.5 0.1 0.1", "0 0.5 0.5 0 0.1", "0 nan 0 1 1", "0 .5 .5 .1 .1"
    )
    write_text(tmp_path / "b.jpg", "no picture")
    write_text(tmp_path / "b.txt", "0 0.5 0.5 0.1 0.1")
    labels = read_labels(f"yolo:{tmp_path}")
    assert labels.boxes == 1
    assert [line.partition(":")[0] for line in labels.skipped] == [
        *(f"{text} line {row}" for row in (1, 2, 3, 4)),
        str(tmp_path / "b.jpg"),
    ]


def coco(**changes: object) -> dict[str, object]:
    content: dict[str, object] = {
        "images": [{"id": 1, "file_name": "a.jpg"}, {"id": 2, "file_name": "b.jpg"}],
        "annotations": [{"id": 1, "image_id": 2, "category_id": 5, "bbox": [10, 20, 4, 8]}],
        "categories": [{"id": 5, "name": "traffic light"}],
    }
    return content | changes


def test_coco_boxes_are_centres_and_sizes_in_px(tmp_path: Path) -> None:
    path = write_text(tmp_path / "boxes.json", json.dumps(coco()))
    first, second = read_labels(f"coco:{path}").pictures
    assert first.boxes_px.shape == (0, 4)
    assert second.path == tmp_path / "b.jpg"
    assert second.boxes_px.tolist() == [[12.0, 24.0, 4.0, 8.0]]
    assert second.classes == ("traffic light",)


def test_coco_crowds_are_places_to_ignore(tmp_path: Path) -> None:
    crowd = {"id": 1, "image_id": 2, "category_id": 5, "bbox": [10, 20, 4, 8], "iscrowd": 1}
    path = write_text(tmp_path / "boxes.json", json.dumps(coco(annotations=[crowd])))
    picture = read_labels(f"coco:{path}").pictures[1]
    assert (picture.boxes_px.shape, picture.ignored_px.tolist()) == ((0, 4), [[12.0, 24.0, 4.0, 8.0]])


def test_coco_finds_pictures_in_the_folder_of_images(tmp_path: Path) -> None:
    write_picture(tmp_path / "images" / "a.jpg")
    path = write_text(tmp_path / "boxes.json", json.dumps(coco()))
    assert read_labels(f"coco:{path}").pictures[0].path == tmp_path / "images" / "a.jpg"


@pytest.mark.parametrize(
    "wrong",
    [
        {"image_id": 3, "category_id": 5, "bbox": [0, 0, 1, 1]},
        {"image_id": 2, "category_id": 6, "bbox": [0, 0, 1, 1]},
        {"image_id": 2, "category_id": 5, "bbox": [0, 0, 1]},
        {"image_id": 2, "category_id": 5, "bbox": [0, 0, -1, 1]},
        {"image_id": 2, "category_id": 5},
        {"image_id": [], "category_id": 5, "bbox": [0, 0, 1, 1]},
        7,
    ],
)
def test_broken_coco_annotations_are_named_and_the_others_stay(tmp_path: Path, wrong: object) -> None:
    good = {"id": 1, "image_id": 2, "category_id": 5, "bbox": [10, 20, 4, 8]}
    path = write_text(tmp_path / "boxes.json", json.dumps(coco(annotations=[wrong, good])))
    labels = read_labels(f"coco:{path}")
    assert labels.boxes == 1
    assert len(labels.skipped) == 1
    assert labels.skipped[0].startswith(f"{path}: annotations[0]: expected ")


def test_a_coco_image_without_a_name_is_named(tmp_path: Path) -> None:
    images = [{"id": 1}, {"id": 2, "file_name": "b.jpg"}, {"id": 2, "file_name": "c.jpg"}]
    path = write_text(tmp_path / "boxes.json", json.dumps(coco(images=images)))
    labels = read_labels(f"coco:{path}")
    assert [picture.path.name for picture in labels.pictures] == ["b.jpg"]
    assert [line.partition(":")[2].split(":")[0] for line in labels.skipped] == [" images[0]", " images[2]"]


@pytest.mark.parametrize(
    ("spec", "content", "message"),
    [
        ("pascal:{0}", "", "expected a format and a place, the format one of bosch, coco, yolo"),
        ("coco", "", "^labels 'coco': expected a format and a place"),
        ("coco:", "", "expected a format and a place"),
        ("bosch:{0}", None, "no such file"),
        ("bosch:{0}", "a: {b", "cannot be read as YAML"),
        ("bosch:{0}", "a: b", "expected a list of pictures, found dict"),
        ("bosch:{0}", "- 3", "no usable picture .1 entries skipped: .* entry 0: expected a path"),
        ("coco:{0}", None, "no such file"),
        ("coco:{0}", "{", "cannot be read as JSON"),
        ("coco:{0}", "[]", "expected an object with a list named images"),
        ("coco:{0}", '{"images": [], "annotations": []}', "expected an object with a list named categories"),
        ("yolo:{0}", None, "no such folder"),
    ],
)
def test_what_is_no_labels_is_refused(tmp_path: Path, spec: str, content: str | None, message: str) -> None:
    path = tmp_path / "labels"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message) as refusal:
        read_labels(spec.format(path))
    assert refusal.value.hint
    assert "\n" not in str(refusal.value)


def test_yolo_pictures_without_any_text_file_are_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="1 pictures, but none has a text file"):
        read_labels(f"yolo:{tmp_path}")


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there are no pictures in it"):
        read_labels(f"yolo:{tmp_path}")


def test_yolo_names_that_are_no_text_are_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg")
    write_text(tmp_path / "a.txt", "0 0.5 0.5 0.1 0.1")
    (tmp_path / "classes.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"classes.txt: cannot be read"):
        read_labels(f"yolo:{tmp_path}")
    (tmp_path / "classes.txt").write_bytes(b"light\r\nsign\r\n")
    assert read_labels(f"yolo:{tmp_path}").class_names == ("light",)


def test_yolo_names_that_are_none_are_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg")
    write_text(tmp_path / "data.yaml", "nc: 3")
    with pytest.raises(InputError, match=r"data.yaml: expected names of the classes"):
        read_labels(f"yolo:{tmp_path}")
