"""`valuemap import kitti`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap import dataset as dataset_folder
from valuemap.cli.import_.app import finish_dataset, import_app
from valuemap.cli.options import DatasetOut, MaxRejected, Up
from valuemap.cli.show import progress_bars
from valuemap.folders import check_place
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("kitti")
def import_kitti(
    poses: Annotated[Path, typer.Option(help="Camera-to-world poses: 12 numbers (3x4) a row and frame.")],
    intrinsics: Annotated[
        tuple[float, float, float, float],
        typer.Option(metavar="FX FY CX CY", help="Pixels; the centre of the top-left pixel is (0, 0) as in KITTI."),
    ],
    image_size: Annotated[tuple[int, int], typer.Option(metavar="W H", help="Pixels.")],
    detections: Annotated[Path, typer.Option(help="CSV: frame,x1,y1,x2,y2 and optionally class, score.")],
    out: DatasetOut,
    class_name: Annotated[str, typer.Option("--class", help="Class of detections without one.")] = "object",
    up: Up = None,
    max_rejected: MaxRejected = MAX_REJECTED,
) -> None:
    """Import KITTI-odometry-style poses with boxes in a CSV file."""
    from valuemap.readers import READERS

    check_place(out, marker=dataset_folder.MARKER)
    with progress_bars() as progress:
        dataset = READERS["kitti"](
            poses,
            intrinsics=intrinsics,
            image_size=image_size,
            detections=detections,
            class_name=class_name,
            up=up,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_dataset(dataset, out)
