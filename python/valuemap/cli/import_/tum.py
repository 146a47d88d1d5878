"""`valuemap import tum`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, PixelCenter, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up
from valuemap.cli.show import progress_bars
from valuemap.readers.detections import DetectionFile
from valuemap.readers.poses import Axes
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("tum")
@with_detections
def import_tum(
    trajectory: Annotated[Path, typer.Argument(help="Text file of poses.")],
    camera: Annotated[str, typer.Option(metavar="TEXT", help='Model, size and parameters: "PINHOLE W H fx fy cx cy".')],
    out: DatasetOut,
    detections: DetectionFile | None,
    image_list: Annotated[Path | None, typer.Option("--images", help="rgb.txt: timestamp, file name.")] = None,
    axes: Annotated[Axes, typer.Option(help="Of what the trajectory is of.")] = "right-down-forward",
    longest_gap: Annotated[float, typer.Option(min=0.0, help="Seconds between poses that are interpolated.")] = 0.2,
    pixel_center: PixelCenter = 0.5,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import a trajectory in TUM's format: t tx ty tz qx qy qz qw, camera to world."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    with progress_bars() as progress:
        found = READERS["tum"].in_portions(
            trajectory,
            detections=detections,
            camera=camera,
            image_list=image_list,
            axes=axes,
            longest_gap_s=longest_gap,
            pixel_center=pixel_center,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_import(found, out, force=force, as_json=as_json)
