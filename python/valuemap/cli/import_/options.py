"""Options that import commands have in common."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from valuemap.errors import SettingError
from valuemap.readers.csv_file import parse_columns
from valuemap.readers.detections import DetectionFile

PixelCenter = Annotated[
    float,
    typer.Option(help="In cx, cy: coordinates of the centre of the top-left pixel, 0.5 (COLMAP) or 0 (OpenCV)."),
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--column", metavar="NAME=THEIRS", help="What a column is called in the file; repeatable."),
]
Anchor = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="LAT LON HEIGHT", help="WGS84 place of the origin of an east-north-up frame."),
]
CameraText = Annotated[
    str | None,
    typer.Option("--camera", metavar="TEXT", help='COLMAP\'s model, size and parameters: "PINHOLE W H fx fy cx cy".'),
]
CameraHeight = Annotated[float, typer.Option(help="Height of cameras that have none, metres.")]
ClassName = Annotated[str, typer.Option("--class", help="Class of detections without one.")]

DetectionFormat = Literal["auto", "coco", "yolo", "cvat", "voc", "labelme", "via", "bosch", "csv"]

_DETECTION_OPTIONS: dict[str, tuple[Any, Any]] = {
    "boxes": (
        Annotated[
            Path | None,
            typer.Option("--detections", help="File or folder of boxes; without, run valuemap detect afterwards."),
        ],
        None,
    ),
    "boxes_format": (
        Annotated[DetectionFormat, typer.Option("--detections-format", help="auto is as the file or folder looks.")],
        "auto",
    ),
    "boxes_class": (ClassName, "object"),
    "boxes_columns": (
        Annotated[
            list[str] | None,
            typer.Option(
                "--detection-column",
                metavar="NAME=THEIRS",
                help="As --column, of boxes in CSV; in via for class.",
            ),
        ],
        None,
    ),
    "boxes_pixel_center": (
        Annotated[
            float | None,
            typer.Option(
                "--detection-pixel-center",
                help="In boxes: the centre of the top-left pixel, 0.5 or 0; default: 0.5, in KITTI's tables 0.",
            ),
        ],
        None,
    ),
    "boxes_fractions": (
        Annotated[bool, typer.Option("--fractions", help="A CSV file of boxes has fractions of width and height.")],
        False,
    ),
    "boxes_full_score": (
        Annotated[float, typer.Option("--full-score", help="The score that means certain; others are divided by it.")],
        1.0,
    ),
    "boxes_images": (
        Annotated[
            Path | None,
            typer.Option("--detection-images", help="COCO file that says which files image_id of results are."),
        ],
        None,
    ),
}


def with_detections(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options that say how to read detections, in the place of its parameter `detections`.

    That parameter is then a `DetectionFile`, or None where no detections are named. A command that has detections of
    its own to give a class to has the option `--class` as its parameter `class_name`, which then is that of both.
    """
    own = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.name != "detections"]
    has_class = any(parameter.name == "class_name" for parameter in own)
    options = {name: option for name, option in _DETECTION_OPTIONS.items() if not (has_class and name == "boxes_class")}
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in options.items()
    ]
    parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own] + added

    @functools.wraps(command)
    def with_file(**values: Any) -> None:
        boxes = {name: values.pop(name) for name in options}
        if has_class:
            of_none = _DETECTION_OPTIONS["boxes_class"][1]
            boxes["boxes_class"] = of_none if boxes["boxes"] is None else values["class_name"]
        command(**values, detections=_detection_file(**boxes))

    with_file.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_file.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_file


def _detection_file(
    boxes: Path | None,
    boxes_format: DetectionFormat,
    boxes_class: str,
    boxes_columns: list[str] | None,
    boxes_pixel_center: float | None,
    boxes_fractions: bool,
    boxes_full_score: float,
    boxes_images: Path | None,
) -> DetectionFile | None:
    if boxes is None:
        given: list[Any] = [boxes_format, boxes_class, boxes_columns or None, boxes_pixel_center, boxes_fractions]
        given += [boxes_full_score, boxes_images]
        usual = [default for name, (_, default) in _DETECTION_OPTIONS.items() if name != "boxes"]
        if given != usual:  # A user would look for an effect that cannot be.
            raise SettingError(
                "detections: options say how to read a file of them, and there is none",
                hint="name the file with --detections, or leave these options away",
            )
        return None
    return DetectionFile(
        boxes,
        format=boxes_format,
        class_name=boxes_class,
        pixel_center=boxes_pixel_center,
        full_score=boxes_full_score,
        columns=parse_columns(boxes_columns or []),
        fractions=boxes_fractions,
        image_list=boxes_images,
    )
