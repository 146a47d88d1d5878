"""`valuemap import ros`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, ClassName, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up
from valuemap.cli.show import progress_bars, show_notes
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("ros")
@with_detections
def import_ros(
    bags: Annotated[list[Path], typer.Argument(help="Bags of ROS 1 or 2 that belong together.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    world_frame: Annotated[str | None, typer.Option(help="The fixed frame; default: the top of the tree.")] = None,
    pose_topic: Annotated[str | None, typer.Option(help="A topic of poses to use instead of tf.")] = None,
    body_frame: Annotated[str | None, typer.Option(help="What these poses are of, such as base_link.")] = None,
    detection_topic: Annotated[
        list[str] | None, typer.Option(help="A topic of detections to use; repeatable. Default: all.")
    ] = None,
    class_name: ClassName = "object",
    rectified: Annotated[bool, typer.Option("--rectified", help="Boxes are on rectified pictures.")] = False,
    box_pixel_center: Annotated[float, typer.Option(help="In boxes of the bags: 0.5 or 0.")] = 0.5,
    longest_gap: Annotated[float, typer.Option(min=0.0, help="Seconds between poses that are interpolated.")] = 0.2,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import ROS bags: CameraInfo, tf or poses, and Detection2DArray; without ROS, with the package rosbags."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["ros"].in_portions(
            bags,
            detections=detections,
            world_frame=world_frame,
            body_frame=body_frame,
            pose_topic=pose_topic,
            detection_topics=detection_topic or (),
            class_name=class_name,
            rectified=rectified,
            pixel_center=box_pixel_center,
            longest_gap_s=longest_gap,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes)
