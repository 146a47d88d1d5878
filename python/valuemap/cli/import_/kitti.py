"""`valuemap import kitti`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up
from valuemap.cli.show import progress_bars
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("kitti")
@with_detections
def import_kitti(
    poses: Annotated[Path, typer.Option(help="Camera-to-world poses: 12 numbers (3x4) a row and frame.")],
    image_size: Annotated[tuple[int, int], typer.Option(metavar="W H", help="Pixels.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    intrinsics: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="FX FY CX CY", help="Pixels; the centre of the top-left pixel is (0, 0) as in KITTI."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calib", help="KITTI's calib.txt instead: the poses are of camera 0.")
    ] = None,
    cameras: Annotated[
        list[int] | None, typer.Option("--camera", help="Of calib.txt, with --calib; repeatable; default: 2.")
    ] = None,
    times: Annotated[Path | None, typer.Option(help="KITTI's times.txt: seconds of a frame a row.")] = None,
    up: Up = None,
    anchor: Anchor = None,
    heading: Annotated[
        float | None,
        typer.Option(min=-360.0, max=360.0, help="Degrees from north of camera 0 in the first frame, with --anchor."),
    ] = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import KITTI-odometry-style poses, with boxes in a CSV file that names frames (frame,x1,y1,x2,y2) or others."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    with progress_bars() as progress:
        found = READERS["kitti"].in_portions(
            poses,
            intrinsics=intrinsics,
            calibration=calibration,
            cameras=tuple(cameras) if cameras else None,
            image_size=image_size,
            detections=detections,
            times=times,
            up=up,
            anchor=anchor,
            heading_deg=heading,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_import(found, out, force=force, as_json=as_json)
