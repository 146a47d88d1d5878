"""Formats of detections: boxes come out where they are in the picture, whatever the poses come from."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from numpy.testing import assert_allclose

from reading import refusal, spoiled, write
from valuemap.coco import read_labelled
from valuemap.dataset import Dataset
from valuemap.errors import InputError
from valuemap.readers.csv_poses import read_csv_poses
from valuemap.readers.detections import DETECTIONS, DetectionFile

# One box of 40 x 20 px with its top-left corner at (100, 50) in the picture a/1.jpg of 640 x 480 px.
CENTER, SIZE = (120.0, 60.0), (40.0, 20.0)

COCO = """{"images": [{"id": 7, "file_name": "a/1.jpg", "width": 640, "height": 480}],
"annotations": [{"image_id": 7, "category_id": 3, "bbox": [100, 50, 40, 20], "score": 0.5}],
"categories": [{"id": 3, "name": "light"}]}"""
CVAT = """<?xml version="1.0" encoding="utf-8"?>
<annotations><version>1.1</version>
<image id="0" name="a/1.jpg" width="640" height="480">
<box label="light" occluded="0" xtl="100.0" ytl="50.0" xbr="140.0" ybr="70.0" z_order="0"></box>
<tag label="night"/></image>
<image id="1" name="a/2.jpg" width="640" height="480"></image></annotations>
"""
BOSCH = """- boxes:
  - {label: light, occluded: false, x_max: 140.0, x_min: 100.0, y_max: 70.0, y_min: 50.0}
  path: ./a/1.jpg
- boxes: []
  path: ./a/2.jpg
"""
VOC = """<annotation><folder>a</folder><filename>a/1.jpg</filename>
<size><width>640</width><height>480</height><depth>3</depth></size>
<object><name>light</name><difficult>0</difficult>
<bndbox><xmin>100</xmin><ymin>50</ymin><xmax>140</xmax><ymax>70</ymax></bndbox></object></annotation>
"""
LABELME = """{"version": "5.5.0", "flags": {}, "shapes": [{"label": "light", "points": [[140.0, 50.0], [100.0, 70.0]],
"group_id": null, "shape_type": "rectangle", "flags": {}}],
"imagePath": "a/1.jpg", "imageData": null, "imageHeight": 480, "imageWidth": 640}
"""
VIA = """{"_via_settings": {"core": {}}, "_via_img_metadata": {"a/1.jpg99": {"filename": "a/1.jpg", "size": 99,
"regions": [{"shape_attributes": {"name": "rect", "x": 100, "y": 50, "width": 40, "height": 20},
"region_attributes": {"kind": "light"}}], "file_attributes": {}},
"a/2.jpg98": {"filename": "a/2.jpg", "size": 98, "regions": [], "file_attributes": {}}}, "_via_attributes": {}}
"""
YOLO = "0 0.1875 0.125 0.0625 0.0416666666666667 0.5\n"
CORNERS = "image,x1,y1,x2,y2,class\na/1.jpg,100,50,140,70,light\n"


def poses_in(folder: Path) -> Path:
    return write(folder / "poses.csv", "image,lat,lon,heading_deg\na/1.jpg,52,4,0\na/2.jpg,52,4.0001,0\n")


def detections_in(folder: Path, kind: str) -> Path:
    """Write the one box in a format, where a reader finds it."""
    if kind == "yolo":
        write(folder / "data.yaml", "names:\n  0: light\n")
        write(folder / "labels" / "a" / "1.txt", YOLO)
        write(folder / "labels" / "a" / "2.txt", "")
        return folder / "labels"
    text, name = {
        "coco": (COCO, "boxes.json"),
        "cvat": (CVAT, "annotations.xml"),
        "voc": (VOC, "1.xml"),
        "labelme": (LABELME, "1.json"),
        "via": (VIA, "via.json"),
        "bosch": (BOSCH, "train.yaml"),
        "csv": (CORNERS, "boxes.csv"),
    }[kind]
    return write(folder / name, text)


def read(folder: Path, file: DetectionFile | Path, **options: Any) -> Dataset:
    return read_csv_poses(poses_in(folder), camera="PINHOLE 640 480 500 500 320 240", detections=file, **options)


@pytest.mark.parametrize("kind", DETECTIONS)
def test_a_box_is_where_it_is_in_the_picture(tmp_path: Path, kind: str) -> None:
    path = detections_in(tmp_path, kind)
    for file in (path, DetectionFile(path, format=kind)):
        dataset = read(tmp_path, file)
        assert_allclose(dataset.detections.center_px, [CENTER], atol=1e-9)
        assert_allclose(dataset.detections.size_px, [SIZE], atol=1e-9)
        assert dataset.detections.class_name.texts() == ["light"]
        assert dataset.images.name.to_pylist()[int(dataset.detections.image_id[0])] == "a/1.jpg"
        assert_allclose(dataset.detections.score, [0.5 if kind in ("coco", "yolo") else 1.0])


def test_a_folder_of_voc_has_a_file_a_picture(tmp_path: Path) -> None:
    """Names without folders are in that of their file; parts of objects are no objects."""
    part = "<part><name>lens</name><bndbox><xmin>1</xmin><ymin>1</ymin><xmax>9</xmax><ymax>9</ymax></bndbox></part>"
    text = VOC.replace("a/1.jpg", "1.jpg")
    write(tmp_path / "voc" / "a" / "1.xml", text.replace("</object>", f"{part}</object>"))
    write(tmp_path / "voc" / "b" / "1.xml", text.replace("light", "sign"))
    write(tmp_path / "voc" / "a" / "2.xml", "<annotation><filename/></annotation>")
    write(tmp_path / "poses.csv", "image,lat,lon,heading_deg\na/1.jpg,52,4,0\nb/1.jpg,52,4.0001,0\na/2.jpg,52,4.1,0\n")
    dataset = read_csv_poses(
        tmp_path / "poses.csv", camera="PINHOLE 640 480 500 500 320 240", detections=tmp_path / "voc"
    )
    names = dataset.images.name.take(dataset.detections.image_id).to_pylist()
    assert list(zip(names, dataset.detections.class_name.texts(), strict=True)) == [
        ("a/1.jpg", "light"),
        ("b/1.jpg", "sign"),
    ]
    assert_allclose(dataset.detections.center_px, [CENTER] * 2)


def test_xml_of_cvat_is_no_voc(tmp_path: Path) -> None:
    path = detections_in(tmp_path, "cvat")
    said = refusal(lambda: read(tmp_path, DetectionFile(path, format="voc")))
    assert "annotations.xml line 2: expected <annotation>, found <annotations>" in said


def test_shapes_of_labelme_count_as_the_boxes_around_them_and_others_are_counted(tmp_path: Path) -> None:
    """All lie within x from 100 to 140 and y from 50 to 70, the circle about the same centre; a mask names pixels."""
    points: dict[str, Any] = {
        "polygon": [[100, 50], [140, 60], [120, 70]],
        "circle": [[120, 60], [120, 80]],
        "mask": [[100, 50], [139, 69]],
        "line": [[1, 2], [3, 4]],
        "point": [[5, 6]],
    }
    shapes: list[Any] = [{"label": kind, "points": where, "shape_type": kind} for kind, where in points.items()]
    shapes[0] = {"label": 7, "points": points["polygon"], "score": 0.25}
    content = {"shapes": shapes, "imagePath": "..\\a\\1.jpg", "imageHeight": None}
    write(tmp_path / "labels" / "1.json", json.dumps(content))
    dataset = read(tmp_path, tmp_path / "labels")
    found = dataset.detections
    assert_allclose(found.center_px, [CENTER] * 3)
    sizes = dict(zip(found.class_name.texts(), found.size_px.tolist(), strict=True))
    assert sizes == {"7": [40.0, 20.0], "mask": [40.0, 20.0], "circle": [40.0, 40.0]}
    assert dict(zip(found.class_name.texts(), found.score.tolist(), strict=True))["7"] == 0.25
    assert dataset.rejected is not None
    assert sorted(dataset.rejected.class_name.texts()) == ["line", "point"]
    assert set(dataset.rejected.reason.texts()) == {"it is a shape without a box, such as points or a line"}


def regions_of_via() -> list[dict[str, Any]]:
    """Four shapes that touch x = 100, x = 140, y = 50 and y = 70 from inside, and two without a box."""
    half_turn = {"name": "ellipse", "cx": 120, "cy": 60, "rx": 10, "ry": 20, "theta": 1.5707963267948966}
    shapes: list[dict[str, Any]] = [
        {"name": "rect", "x": 100, "y": 50, "width": 40, "height": 20},
        {"name": "polygon", "all_points_x": [100, 140, 120], "all_points_y": [50, 60, 70]},
        half_turn,
        {"name": "point", "cx": 1, "cy": 2},
        {"name": "polyline", "all_points_x": [1, 2], "all_points_y": [3, 4]},
    ]
    return [
        {"shape_attributes": shape, "region_attributes": {"kind": shape["name"], "lit": {"yes": True}}}
        for shape in shapes
    ]


@pytest.mark.parametrize("version", ["project", "export 1", "export 2", "table 1", "table 2"])
def test_regions_of_via_in_all_that_it_writes(tmp_path: Path, version: str) -> None:
    regions = regions_of_via()
    if version.startswith("table"):
        rows = [(json.dumps(each["shape_attributes"]), json.dumps(each["region_attributes"])) for each in regions]
        lines = [("#" if version.endswith("1") else "") + "filename,file_size,file_attributes,region_count,region_id,"]
        lines[0] += "region_shape_attributes,region_attributes"
        quoted = [[text.replace('"', '""') for text in row] for row in rows]
        lines += [f'a/1.jpg,99,"{{}}",5,{i},"{shape}","{said}"' for i, (shape, said) in enumerate(quoted)]
        lines.append('a/2.jpg,98,"{}",0,0,"{}","{}"')
        path = write(tmp_path / "via.csv", "\n".join(lines) + "\n")
    else:
        of_picture: Any = {str(i): each for i, each in enumerate(regions)} if version == "export 1" else regions
        pictures = {
            "1.jpg99": {"filename": "a/1.jpg", "size": 99, "regions": of_picture},
            "2.jpg98": {"filename": "a/2.jpg", "size": 98, "regions": {} if version == "export 1" else []},
        }
        content = {"_via_settings": {}, "_via_img_metadata": pictures} if version == "project" else pictures
        path = write(tmp_path / "via.json", json.dumps(content))
    dataset = read(tmp_path, DetectionFile(path, columns={"class": "kind"}))
    assert sorted(dataset.detections.class_name.texts()) == ["ellipse", "polygon", "rect"]
    assert_allclose(dataset.detections.center_px, [CENTER] * 3)
    assert_allclose(dataset.detections.size_px, [SIZE] * 3)
    assert dataset.rejected is not None
    assert sorted(dataset.rejected.class_name.texts()) == ["point", "polyline"]
    # What is ticked is a class as well; here it is the same of all.
    ticked = read(tmp_path, DetectionFile(path, columns={"class": "lit"}, class_name="unused"), max_rejected=0.9)
    assert set(ticked.detections.class_name.texts()) == {"yes"}
    assert "detection-column class=NAME" in refusal(lambda: read(tmp_path, path))
    assert "detection-column score" in refusal(lambda: read(tmp_path, DetectionFile(path, columns={"score": "lit"})))


def test_regions_of_via_without_attributes_have_the_class_of_the_option(tmp_path: Path) -> None:
    path = write(tmp_path / "via.json", VIA.replace('"kind": "light"', ""))
    assert read(tmp_path, DetectionFile(path, class_name="sign")).detections.class_name.texts() == ["sign"]


def test_a_file_of_coco_in_a_folder_is_named(tmp_path: Path) -> None:
    """As Roboflow writes it, between the pictures."""
    path = write(tmp_path / "train" / "_annotations.coco.json", COCO)
    said = refusal(lambda: read(tmp_path, path.parent))
    assert "_annotations.coco.json is no such file" in said
    assert f"it is coco: name the file itself, --detections {path}" in said
    write(path, '{"imgHeight": 480, "imgWidth": 640, "objects": []}')
    assert "Cityscapes, can be a CSV table" in refusal(lambda: read(tmp_path, path.parent))


def test_labels_of_kitti_are_told_from_rows_of_yolo(tmp_path: Path) -> None:
    folder = detections_in(tmp_path, "yolo")
    write(folder / "a" / "1.txt", "Car 0.00 0 -1.58 100.0 50.0 140.0 70.0 1.5 1.5 1.5 -0.5 1.5 40.0 -1.5\n")
    assert "is it a label of KITTI? Make a CSV table" in refusal(lambda: read(tmp_path, folder))


def test_a_folder_of_several_formats_is_not_guessed_at(tmp_path: Path) -> None:
    folder = detections_in(tmp_path, "yolo")
    write(folder / "a" / "1.xml", VOC)
    said = refusal(lambda: read(tmp_path, folder))
    assert "has files of several formats of detections: .txt, .xml" in said
    assert "yolo for .txt, voc for .xml" in said
    for kind in ("yolo", "voc"):
        assert_allclose(read(tmp_path, DetectionFile(folder, format=kind)).detections.center_px, [CENTER])


@pytest.mark.parametrize(("kind", "option"), [("coco", "fractions"), ("yolo", "fractions"), ("voc", "columns")])
def test_options_that_a_format_does_not_have_are_refused(tmp_path: Path, kind: str, option: str) -> None:
    value: Any = {"class": "label"} if option == "columns" else True
    file = DetectionFile(detections_in(tmp_path, kind), **{option: value})
    assert f"not with {kind}" in refusal(lambda: read(tmp_path, file))


@pytest.mark.parametrize(
    ("table", "options"),
    [
        ("image,left,top,width,height\na/1.jpg,100,50,40,20\n", {}),
        ("image,x,y,width,height\na/1.jpg,120,60,40,20\n", {}),
        ("Image;X1;Y1;X2;Y2\na/1.jpg;100;50;140;70\n", {}),
        ("image,x1,y1,x2,y2\na/1.jpg,99.5,49.5,139.5,69.5\n", {"pixel_center": 0.0}),
        ("image,x,y,width,height\na/1.jpg,0.1875,0.125,0.0625,0.0416666666666667\n", {"fractions": True}),
        (
            "Filename;Annotation tag;Upper left corner X;Upper left corner Y;Lower right corner X;"
            "Lower right corner Y\n"
            "a/1.jpg;light;100;50;140;70\n",
            {
                "columns": {
                    "image": "Filename",
                    "class": "Annotation tag",
                    "x1": "Upper left corner X",
                    "y1": "Upper left corner Y",
                    "x2": "Lower right corner X",
                    "y2": "Lower right corner Y",
                }
            },
        ),
    ],
)
def test_a_table_may_say_the_same_box_in_many_ways(tmp_path: Path, table: str, options: dict[str, Any]) -> None:
    path = write(tmp_path / "boxes.csv", table)
    dataset = read(tmp_path, DetectionFile(path, class_name="light", **options))
    assert_allclose(dataset.detections.center_px, [CENTER], atol=1e-9)
    assert_allclose(dataset.detections.size_px, [SIZE], atol=1e-9)
    assert dataset.detections.class_name.texts() == ["light"]


def test_a_range_and_a_vertical_sigma_may_be_given(tmp_path: Path) -> None:
    path = write(
        tmp_path / "boxes.csv", "image,x,y,score,range_m,range_sigma_m,vertical_sigma_px\na/1.jpg,9,9,0.3,12,2,44\n"
    )
    found = read(tmp_path, path).detections
    assert found.range_m is not None
    assert found.range_sigma_m is not None
    assert found.vertical_sigma_px is not None
    assert (found.range_m[0], found.range_sigma_m[0], found.vertical_sigma_px[0]) == (12.0, 2.0, 44.0)
    assert not found.size_px.any()


def test_names_as_windows_writes_them(tmp_path: Path) -> None:
    """Separators the other way, suffixes in capitals, lines that end in two characters."""
    boxes = write(tmp_path / "boxes.json", COCO.replace("a/1.jpg", "a\\\\1.JPG").replace("\n", "\r\n"))
    assert_allclose(read(tmp_path, boxes).detections.center_px, [CENTER])
    labels = write(tmp_path / "labels" / "1.TXT", YOLO.replace("\n", "\r\n")).parent
    assert_allclose(read(tmp_path, labels).detections.center_px, [CENTER])


@pytest.mark.parametrize(("start", "what"), [(b"\x1f\x8b\x08", "is gzip"), (b"PK\3\4", "is a zip archive")])
def test_packed_files_are_named(tmp_path: Path, start: bytes, what: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_bytes(start + b"\0" * 40)
    said = refusal(lambda: read(tmp_path, path))
    assert what in said
    assert "unpack it first" in said


def test_a_packed_table_is_known_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "boxes.CSV.gz"
    path.write_bytes(gzip.compress(CORNERS.encode()))
    assert_allclose(read(tmp_path, path).detections.center_px, [CENTER])


@pytest.mark.parametrize(("turn", "size"), [("90.0", (20.0, 40.0)), ("180", (40.0, 20.0)), ("30", (44.6410, 37.3205))])
def test_the_box_around_a_turned_box_of_cvat(tmp_path: Path, turn: str, size: tuple[float, float]) -> None:
    """Rectangles may be turned about their middle, in degrees."""
    path = write(tmp_path / "a.xml", CVAT.replace('occluded="0"', f'occluded="0" rotation="{turn}"'))
    found = read(tmp_path, path).detections
    assert_allclose(found.center_px, [CENTER])
    assert_allclose(found.size_px, [size], atol=1e-4)


SHAPES = """<image id="0" name="a/1.jpg" width="640" height="480">
<skeleton label="skeleton"><points label="head" points="1,2" outside="0"/></skeleton>
<box label="box" xtl="100" ytl="50" xbr="140" ybr="70"/>
<polygon label="polygon" points="100.0,50.0;140.0,60.0;120.0,70.0"/>
<mask label="mask" rle="2, 796, 2" left="100" top="50" width="40" height="20"/>
<ellipse label="ellipse" cx="120" cy="60" rx="10" ry="20" rotation="90"/>
<points label="points" points="7,8"/><polyline label="polyline" points="1,2;3,4;9,9"/>
<cuboid label="cuboid" xtl1="1" ytl1="2"/><tag label="night"/></image>"""


def test_shapes_of_cvat_count_as_the_boxes_around_them_and_others_are_counted(tmp_path: Path) -> None:
    """All four shapes lie within x from 100 to 140 and y from 50 to 70, and touch these edges."""
    path = write(tmp_path / "a.xml", f"<annotations><version>1.1</version>{SHAPES}</annotations>")
    dataset = read(tmp_path, path)
    assert sorted(dataset.detections.class_name.texts()) == ["box", "ellipse", "mask", "polygon"]
    assert_allclose(dataset.detections.center_px, [CENTER] * 4)
    assert_allclose(dataset.detections.size_px, [SIZE] * 4)
    assert dataset.rejected is not None
    assert sorted(dataset.rejected.class_name.texts()) == ["cuboid", "points", "polyline", "skeleton"]
    assert set(dataset.rejected.reason.texts()) == {"it is a shape without a box, such as points or a line"}


def test_a_crowd_of_coco_is_no_detection_and_no_fault(tmp_path: Path) -> None:
    content = json.loads(COCO)
    one = content["annotations"][0]
    content["annotations"] = [{**one, "iscrowd": 0}, {**one, "iscrowd": 1, "bbox": [0, 0, 600, 400]}]
    dataset = read(tmp_path, write(tmp_path / "boxes.json", json.dumps(content)))
    assert_allclose(dataset.detections.size_px, [SIZE])
    assert dataset.rejected is not None
    assert dataset.rejected.reason.texts() == ["it is marked as a crowd: a region of many objects"]
    content["annotations"] += [*[{**one, "iscrowd": 1}] * 2, *[{**one, "bbox": None}] * 2]
    said = refusal(lambda: read(tmp_path, write(tmp_path / "boxes.json", json.dumps(content))))
    assert "5 of 6 boxes cannot be used, more than 1 %: a number is missing or not finite (2," in said
    assert "| repair these rows" in said


def test_ids_of_coco_are_texts_in_one_list_and_numbers_in_another(tmp_path: Path) -> None:
    content = json.loads(COCO)
    plain = read(tmp_path, write(tmp_path / "plain.json", COCO)).detections
    for change in ("images", "categories", "annotations"):
        given = json.loads(COCO)
        keys = ("image_id", "category_id") if change == "annotations" else ("id",)
        for entry in given[change]:
            entry |= {key: str(entry[key]) for key in keys}
        path = write(tmp_path / f"{change}.json", json.dumps(given))
        found = read(tmp_path, path).detections
        assert found.image_id.tolist() == plain.image_id.tolist()
        assert found.class_name.texts() == plain.class_name.texts() == ["light"]
        labels = read_labelled(path)
        assert (labels.image, labels.class_name, labels.skipped) == ([given["images"][0]["id"]], ["light"], [])
    # Where both are ids, each is its own.
    content["images"].append({"id": str(content["images"][0]["id"]), "file_name": "a/2.jpg"})
    found = read(tmp_path, write(tmp_path / "both.json", json.dumps(content))).detections
    assert found.image_id.tolist() == plain.image_id.tolist()


def test_results_of_coco_with_numbers_only_are_of_the_listed_images(tmp_path: Path) -> None:
    """As pycocotools, Detectron2 and MMDetection write them: the names are in the file that the detector ran on."""
    result = {"image_id": 7, "category_id": 3, "bbox": [100, 50, 40, 20], "score": 0.5}
    path = write(tmp_path / "results.json", json.dumps([result, {**result, "file_name": "a/2.jpg"}]))
    listed = write(tmp_path / "instances.json", COCO)
    said = refusal(lambda: read(tmp_path, path))
    assert "results[0]: image_id 7 does not say which file it is (1 entries)" in said
    assert "--detection-images" in said
    dataset = read(tmp_path, DetectionFile(path, image_list=listed))
    assert dataset.detections.class_name.texts() == ["light", "light"]
    assert dataset.images.name.take(dataset.detections.image_id).to_pylist() == ["a/1.jpg", "a/2.jpg"]
    assert_allclose(dataset.detections.center_px, [CENTER] * 2)
    assert_allclose(dataset.detections.score, [0.5] * 2)
    write(listed, COCO.replace('"id": 7', '"id": 8'))
    said = refusal(lambda: read(tmp_path, DetectionFile(path, image_list=listed)))
    assert "its image is not among the images with a pose (1, the first is" in said
    assert "'image_id 7'" in said
    write(listed, json.dumps({**json.loads(COCO), "categories": {"light": 3}}))
    said = refusal(lambda: read(tmp_path, DetectionFile(path, image_list=listed)))
    assert said.startswith(f"{listed}: expected a list")
    write(listed, COCO.replace("640", "1280"))
    assert "found 1280 x 480" in refusal(lambda: read(tmp_path, DetectionFile(path, image_list=listed)))
    for other in (listed, tmp_path / "b.csv"):
        file = DetectionFile(other, image_list=listed)
        assert "detection-images" in refusal(partial(read, tmp_path, file))


@pytest.mark.parametrize(
    "name", ["images/0d1f2a3b-1.jpg", "upload\\3\\0D1F2A3B-1.jpg", "1_jpg.rf.034d0c9f9a0edda727b2bc56fd073177.jpg"]
)
def test_names_that_tools_for_labels_gave_find_their_images(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "boxes.csv", CORNERS.replace("a/1.jpg", name))
    assert_allclose(read(tmp_path, path).detections.center_px, [CENTER])
    again = CORNERS.replace("a/1.jpg", name) + name.replace("3", "4") + ",1,2,30,40,light\n"
    assert "its image is not among" in refusal(lambda: read(tmp_path, write(tmp_path / "boxes.csv", again)))


def test_an_empty_row_says_that_nothing_is_in_the_picture(tmp_path: Path) -> None:
    path = write(tmp_path / "boxes.csv", CORNERS + "a/2.jpg,,,,,\n")
    dataset = read(tmp_path, path)
    assert_allclose(dataset.detections.center_px, [CENTER])
    assert dataset.rejected is not None
    assert dataset.rejected.reason.texts() == ["its row is empty but for the image: nothing is in the picture"]
    for row in ("a/2.jpg,x,,,,\n", "a/2.jpg,,,,,light\n", "a/2.jpg,1,,,,\n"):
        write(path, CORNERS + row)
        assert "a number is missing or not finite" in refusal(lambda: read(tmp_path, path))


def test_sizes_of_pictures_in_a_table_of_edges_are_looked_at(tmp_path: Path) -> None:
    """TensorFlow's table has the size of the picture as width, height; in others they are those of the box."""
    table = "filename,width,height,class,xmin,ymin,xmax,ymax\na/1.jpg,{},light,100,50,140,70\n"
    columns = {"image": "filename", "x1": "xmin", "y1": "ymin", "x2": "xmax", "y2": "ymax"}
    for size in ("640,480", "40,20", "700.5,500.5"):
        path = write(tmp_path / "boxes.csv", table.format(size))
        assert_allclose(read(tmp_path, DetectionFile(path, columns=columns)).detections.center_px, [CENTER])
    assert "--detection-column x1=xmin" in refusal(lambda: read(tmp_path, path))
    write(path, table.format("320,240") + "a/2.jpg,320,240,,,,,\n")
    said = refusal(lambda: read(tmp_path, DetectionFile(path, columns=columns)))
    assert "'a/1.jpg': expected 640 x 480 px as in the model, found 320 x 240" in said
    write(path, "image,x1,y1,x2,y2,width,height\na/1.jpg,0.15625,0.104166666667,0.21875,0.145833333333,320,240\n")
    assert_allclose(read(tmp_path, DetectionFile(path, fractions=True)).detections.center_px, [CENTER], atol=1e-6)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([{"name": "a/1.jpg", "labels": []}], "results[0]: has neither image_id nor file_name (1 entries) | is it a"),
        (
            [{"data": {"image": "1.jpg"}, "annotations": []}],
            "Label Studio, Supervisely, Labelbox and the like export COCO",
        ),
        ({"frames": [{"name": "1.jpg", "labels": []}]}, "as BDD100K, nuImages and Cityscapes, can be a CSV table"),
        ([{"file_name": "a/1.png", "segments_info": []}], "results[0]: is a panoptic segmentation"),
    ],
)
def test_json_that_is_no_list_of_boxes_is_told_apart(tmp_path: Path, content: Any, said: str) -> None:
    path = write(tmp_path / "boxes.json", json.dumps(content))
    assert said in refusal(lambda: read(tmp_path, path))


def test_a_size_of_0_in_coco_says_that_it_is_not_known(tmp_path: Path) -> None:
    """Datumaro writes it, and CVAT by it."""
    path = write(tmp_path / "boxes.json", COCO.replace("640", "0").replace("480", "0"))
    assert_allclose(read(tmp_path, path).detections.center_px, [CENTER])


def test_coco_as_tools_write_it(tmp_path: Path) -> None:
    """A score that is null, sizes as texts, and polygons without a box."""
    content = json.loads(COCO)
    content["images"] = [{**each, "width": "640", "height": "480"} for each in content["images"]]
    annotation = {key: value for key, value in content["annotations"][0].items() if key != "bbox"}
    corners = [[100, 50, 140, 50, 140, 70], [100, 60, 120, 60, 120, 70]]
    content["annotations"] = [{**annotation, "score": None, "segmentation": corners}]
    dataset = read(tmp_path, write(tmp_path / "boxes.json", json.dumps(content)))
    assert dataset.detections.center_px.tolist() == [[120.0, 60.0]]
    assert dataset.detections.size_px.tolist() == [[40.0, 20.0]]
    assert dataset.detections.score.tolist() == [1.0]


def test_a_label_file_of_blank_lines_says_that_nothing_is_there(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "2.txt", "\ufeff\r\n\n")
    (tmp_path / "data.yaml").rename(tmp_path / "data.yml")
    assert read(tmp_path, labels).detections.class_name.texts() == ["light"]


def test_a_class_of_yolo_that_is_not_among_the_names_is_left_out(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", "0 0.1875 0.125 0.0625 0.04\n9 0.5 0.125 0.0625 0.04\n")
    said = refusal(lambda: read(tmp_path, labels))
    assert "1 of 2 boxes cannot be used, more than 1 %: its class is missing, or not in the list of classes" in said


def test_one_file_of_yolo_and_an_archive_are_not_read_for_something_else(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", "0 0.1875 0.125 0.0625 0.04 0.5\n")
    said = refusal(lambda: read(tmp_path, labels / "a" / "1.txt"))
    assert f"is of one picture | name the folder with the files of all pictures: --detections {labels / 'a'}" in said
    (tmp_path / "annotations.zip").write_bytes(b"PK\3\4...")
    said = refusal(lambda: read(tmp_path, tmp_path / "annotations.zip"))
    assert "annotations.zip: is a zip archive or a spreadsheet | unpack it first" in said


def test_a_polygon_of_yolo_counts_as_its_box(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", "0 0.15625 0.125 0.1875 0.104166666667 0.21875 0.125 0.1875 0.145833333333\n")
    dataset = read(tmp_path, labels)
    assert_allclose(dataset.detections.center_px, [CENTER], atol=1e-6)
    assert_allclose(dataset.detections.size_px, [SIZE], atol=1e-6)
    assert dataset.detections.class_name.texts() == ["light"]


@pytest.mark.parametrize(
    "row",
    [
        "0 0.15625 0.125 0.1875 0.104166666667 0.21875 0.125 0.1875 0.145833333333 0.5",  # A polygon.
        "0 0.1875 0.125 0.0625 0.0416666666666667 0.5 1",  # Of the first object that was tracked.
        "0 0.1875 0.125 0.0625 0.0416666666666667 0.5 27",
    ],
)
def test_confidences_of_polygons_and_numbers_of_tracks_of_yolo(tmp_path: Path, row: str) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", row + "\n")
    found = read(tmp_path, labels).detections
    assert_allclose(found.center_px, [CENTER], atol=1e-6)
    assert_allclose(found.size_px, [SIZE], atol=1e-6)
    assert_allclose(found.score, [0.5])


BOX = "0.1875 0.125 0.0625 0.0416666666666667"
OUTLINE = "0.15625 0.125 0.1875 0.104166666667 0.21875 0.125 0.1875 0.145833333333"


@pytest.mark.parametrize(
    ("first", "second", "score"),
    [
        (f"0 {BOX} 12", f"0 {BOX} 1", 1.0),  # Tracks without confidences.
        (f"0 {OUTLINE} 0.5 12", f"0 {OUTLINE} 0.5 1", 0.5),
        (f"0 {OUTLINE} 12", f"0 {OUTLINE} 1", 1.0),
        (f"0.0 {BOX} 0.5", f"0.0 {BOX} 0.5", 0.5),  # As NumPy writes whole numbers.
    ],
)
def test_numbers_of_tracks_of_yolo_are_told_from_the_whole_folder(
    tmp_path: Path, first: str, second: str, score: float
) -> None:
    """Where one is larger than 1, which no fraction or confidence is, the others are numbers of tracks too."""
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", first + "\n")
    write(labels / "a" / "2.txt", second + "\n")
    found = read(tmp_path, labels).detections
    assert_allclose(found.center_px, [CENTER] * 2, atol=1e-6)
    assert_allclose(found.size_px, [SIZE] * 2, atol=1e-6)
    assert_allclose(found.score, [score] * 2)
    assert found.class_name.texts() == ["light"] * 2


def test_confidences_of_yolo_in_percent_are_no_numbers_of_tracks(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", f"0 {BOX} 85\n0 0.5 0.5 0.1 0.1 85\n")
    write(labels / "a" / "2.txt", f"0 {BOX} 90\n")
    assert "3 of 3 boxes cannot be used, none is left: its score is not from 0 to 1" in refusal(
        lambda: read(tmp_path, labels)
    )


def test_an_outline_of_yolo_that_touches_the_lower_edge_has_no_number_of_a_track(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(labels / "a" / "1.txt", "0 0.25 0.5 0.5 0.5 0.5 0.75 0.25 1\n")
    assert_allclose(read(tmp_path, labels).detections.center_px, [[240.0, 360.0]])


def test_key_points_of_yolo_count_for_nothing_where_it_is_said_how_many_there_are(tmp_path: Path) -> None:
    labels = detections_in(tmp_path, "yolo")
    write(tmp_path / "data.yaml", "kpt_shape: [2, 3]\nnames: {0: light}\n")
    write(labels / "a" / "1.txt", f"0 {BOX} 0.1 0.1 2 0.9 0.9 2 0.5\n")
    found = read(tmp_path, labels).detections
    assert_allclose(found.center_px, [CENTER], atol=1e-6)
    assert_allclose(found.size_px, [SIZE], atol=1e-6)
    assert_allclose(found.score, [0.5])


@pytest.mark.parametrize("layout", ["labels/train", "train/labels"])
def test_names_of_classes_of_yolo_may_be_two_folders_above_and_numbers(tmp_path: Path, layout: str) -> None:
    write(tmp_path / layout / "a" / "1.txt", f"0 {BOX}\n1 0.5 0.5 0.1 0.1\n")
    write(tmp_path / "data.yaml", "names: [50, stop]\n")
    assert sorted(read(tmp_path, tmp_path / layout).detections.class_name.texts()) == ["50", "stop"]
    write(tmp_path / "data.yaml", "names: {'0': light, 1: no}\n")
    assert "expected a class by its number, found 1: False" in refusal(lambda: read(tmp_path, tmp_path / layout))


@pytest.mark.parametrize("kind", DETECTIONS)
def test_boxes_of_unknown_images_are_left_out_and_named(tmp_path: Path, kind: str) -> None:
    path = detections_in(tmp_path, kind)
    where = path / "a" / "1.txt" if kind == "yolo" else path
    if kind == "yolo":
        where.rename(path / "a" / "9.txt")
    else:
        where.write_text(where.read_text().replace("a/1.jpg", "a/9.jpg"))
    assert "its image is not among the images with a pose" in refusal(lambda: read(tmp_path, path))


@pytest.mark.parametrize(
    ("image", "name", "is_told"),
    [("0007", "7", True), ("a/0070.jpg", "70.0", True), ("a/pass_01_007.jpg", "pass_1_7.jpg", True)]
    + [("0007", "70", False), ("a/0007.jpg", "b/7.jpg", False)],
)
def test_names_that_a_spreadsheet_took_for_numbers_are_told(
    tmp_path: Path, image: str, name: str, *, is_told: bool
) -> None:
    poses = write(tmp_path / "poses.csv", f"image,lat,lon,heading_deg\n{image},52,4,0\nx/2.jpg,52,4.0001,0\n")
    boxes = write(tmp_path / "boxes.csv", CORNERS.replace("a/1.jpg", name))
    with pytest.raises(InputError, match="its image is not among the images with a pose") as error:
        read_csv_poses(poses, camera="PINHOLE 640 480 500 500 320 240", detections=boxes)
    assert (f"{name!r} would be {image!r} but for zeros: has a spreadsheet" in error.value.hint) == is_told


@pytest.mark.parametrize("kind", ["coco", "cvat", "voc", "labelme"])
def test_boxes_made_on_pictures_of_another_size_are_refused(tmp_path: Path, kind: str) -> None:
    path = detections_in(tmp_path, kind)
    path.write_text(path.read_text().replace("640", "1280"))
    assert "expected 640 x 480 px as in the model, found 1280 x 480" in refusal(lambda: read(tmp_path, path))


def test_a_size_of_voc_may_have_a_decimal_point(tmp_path: Path) -> None:
    path = write(tmp_path / "1.xml", VOC.replace("640", "1280.0"))
    assert "expected 640 x 480 px as in the model, found 1280 x 480" in refusal(lambda: read(tmp_path, path))


@pytest.mark.parametrize("how", ["empty", "cut", "binary", "other", "pipe", "folder", "absent"])
@pytest.mark.parametrize("kind", [kind for kind in DETECTIONS if kind != "yolo"])
def test_files_that_are_of_no_such_format(tmp_path: Path, kind: str, how: str) -> None:
    path = spoiled(detections_in(tmp_path, kind), how)
    if (kind, how) != ("csv", "cut"):  # A cut line of a table is a shorter number.
        assert path.name in refusal(lambda: read(tmp_path, DetectionFile(path, format=kind)))


@pytest.mark.parametrize("how", ["binary", "other", "pipe", "link"])
def test_label_files_that_are_not_yolos(tmp_path: Path, how: str) -> None:
    folder = detections_in(tmp_path, "yolo")
    spoiled(folder / "a" / "1.txt", how)
    assert "1.txt" in refusal(lambda: read(tmp_path, folder))


def test_folders_without_labels(tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    assert "there are no .txt files in it" in refusal(lambda: read(tmp_path, tmp_path / "labels"))
    (tmp_path / "labels" / "a.txt").write_text("")
    assert "there are no detections in it" in refusal(lambda: read(tmp_path, tmp_path / "labels"))


@pytest.mark.parametrize(
    "row",
    [
        "0 0.1 0.2 0.3",
        "light 0.1 0.2 0.3 0.4",
        "-1 0.1 0.2 0.3 0.4",
        "0 0.1 0.2 0.3 0.4 0.5 0.6 0.7",
        "0.5 1 1 1 1",
        "0 0.1 0.1 0.2 0.1 0.2 0.2 0.1 0.2 0.5 12",  # The number of a track is no place.
    ],
)
def test_rows_that_are_not_yolos(tmp_path: Path, row: str) -> None:
    folder = detections_in(tmp_path, "yolo")
    write(folder / "a" / "1.txt", f"{YOLO}{row}\n")
    assert "1.txt line 2: expected class cx cy width height" in refusal(lambda: read(tmp_path, folder))


def test_an_alias_bomb_is_refused_before_it_goes_off(tmp_path: Path) -> None:
    levels = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12))
    path = write(tmp_path / "train.yaml", f"a0: &a0 [x, x]\n{levels}")
    assert "train.yaml: cannot be read as YAML: it has an alias, *a0" in refusal(lambda: read(tmp_path, path))


def test_an_entity_bomb_is_refused_before_it_goes_off(tmp_path: Path) -> None:
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    path = write(tmp_path / "a.xml", f'<!DOCTYPE a [<!ENTITY a0 "x">{entities}]><annotations>&a11;</annotations>')
    assert "a.xml line 1: has a document type" in refusal(lambda: read(tmp_path, path))


def test_an_outer_entity_is_not_read(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.xml", '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><annotations>&x;</annotations>'
    )
    assert "has a document type" in refusal(lambda: read(tmp_path, path))


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        ("cvat", lambda text: text.replace('xtl="100.0"', 'xtl="x"'), "line 4: xtl: expected a number, found 'x'"),
        ("cvat", lambda text: text.replace(' label="light"', ""), "line 4: expected label=..."),
        ("cvat", lambda text: text.replace("<box ", '<box rotation="inf" ', 1), "rotation: expected a number"),
        ("cvat", lambda text: text.replace('width="640"', 'width="inf"'), "width: expected a number"),
        (
            "cvat",
            lambda text: text.replace("<tag label", '<polygon points="1,2;5,6" label'),
            "line 5: points: expected x,y;x,y;x,y",
        ),
        ("cvat", lambda text: text.replace("<image ", "<track ").replace("</image>", "</track>"), "tracks name frames"),
        (
            "cvat",
            lambda text: text.replace("<image ", "<picture ").replace("</image>", "</picture>"),
            "no images in it",
        ),
        ("voc", lambda text: text.replace(">140<", "><"), "a number is missing or not finite (1, the first is"),
        ("voc", lambda text: text.replace("<name>light</name>", ""), "its class is missing"),
        ("labelme", lambda text: text.replace(", [100.0, 70.0]", ""), "expected at least 2 points of a rectangle"),
        ("labelme", lambda text: text.replace("70.0", "NaN"), "points[1]: expected a list of 2 finite numbers"),
        ("labelme", lambda text: text.replace('"shapes"', '"objects"'), "expected 'shapes', found version, flags"),
        ("via", lambda text: text.replace('"rect"', '"blob"'), "name: expected rect, polygon, circle"),
        ("via", lambda text: text.replace('"width": 40', '"width": "wide"'), "width: expected a finite number"),
        ("via", lambda text: text.replace('"light"', '"light", "lit": "yes"'), "no attribute 'class', but kind, lit"),
        ("via", lambda _: '{"project": {}, "file": {"1": 1}, "metadata": {"1": 1}, "view": {"1": 1}}', "of VIA 3"),
        ("bosch", lambda text: text.replace("x_max: 140.0", "x_max: wide"), "[0]: boxes[0]: x_max: expected a finite"),
        ("bosch", lambda text: text.replace("path: ./a/1.jpg", "file: ./a/1.jpg"), "[0]: expected 'path'"),
        ("bosch", lambda _: "boxes: []\n", "expected a list"),
        ("csv", lambda text: text.replace("y2", "y3"), "expected x1, y1, x2, y2, or left, top"),
        ("csv", lambda text: text.replace("image", "picture"), "expected a column 'image'"),
        ("csv", lambda text: text.replace("140", "x"), "a number is missing or not finite"),
    ],
)
def test_bad_values(tmp_path: Path, kind: str, change: Callable[[str], str], said: str) -> None:
    path = detections_in(tmp_path, kind)
    path.write_text(change(path.read_text()))
    assert said in refusal(lambda: read(tmp_path, path))


def test_options_that_cannot_be(tmp_path: Path) -> None:
    path = detections_in(tmp_path, "csv")
    assert "there is no such format" in refusal(lambda: read(tmp_path, DetectionFile(path, format="tfrecord")))
    assert "full-score: expected above 0" in refusal(lambda: DetectionFile(path, full_score=0.0))
    assert "detection-pixel-center: expected 0 or 0.5" in refusal(lambda: DetectionFile(path, pixel_center=1.0))
    path.rename(tmp_path / "boxes.dat")
    assert "does not say the format" in refusal(lambda: read(tmp_path, tmp_path / "boxes.dat"))
    assert len(read(tmp_path, DetectionFile(tmp_path / "boxes.dat", format="csv")).detections) == 1
