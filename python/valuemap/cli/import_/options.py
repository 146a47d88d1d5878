"""Options that import commands have in common."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from valuemap.readers.csv_file import parse_columns
from valuemap.readers.detections import DETECTIONS, DetectionFile

Detections = Annotated[
    Path | None,
    typer.Option("--detections", help="File or folder of boxes; without, run valuemap detect afterwards."),
]
DetectionsFormat = Annotated[
    str, typer.Option("--detections-format", help=f"auto (by its name), {', '.join(DETECTIONS)}.")
]
DetectionColumns = Annotated[
    list[str] | None,
    typer.Option("--detection-column", metavar="NAME=THEIRS", help="A column of a CSV file of boxes; repeatable."),
]
ClassName = Annotated[str, typer.Option("--class", help="Class of detections without one.")]
PixelCenter = Annotated[
    float,
    typer.Option(help="Coordinates of the centre of the top-left pixel: 0.5 (COLMAP, COCO) or 0 (OpenCV, KITTI)."),
]
FullScore = Annotated[float, typer.Option(help="The score that means certain; scores are divided by it.")]
Fractions = Annotated[
    bool, typer.Option("--fractions", help="Boxes of a CSV file are fractions of the picture's width and height.")
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


def detection_file(
    path: Path | None,
    format_: str = "auto",
    *,
    class_name: str = "object",
    columns: Sequence[str] | None = None,
    pixel_center: float = 0.5,
    full_score: float = 1.0,
    fractions: bool = False,
) -> DetectionFile | None:
    """Return how to read the detections that the options name; None where they name none."""
    if path is None:
        return None
    return DetectionFile(
        path,
        format=format_,
        class_name=class_name,
        pixel_center=pixel_center,
        full_score=full_score,
        columns=parse_columns(columns or []),
        fractions=fractions,
    )
