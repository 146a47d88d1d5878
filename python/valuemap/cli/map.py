"""`valuemap map`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from valuemap import map_folder
from valuemap.calibration import read_calibration
from valuemap.cli.app import app
from valuemap.cli.options import (
    DEFAULT_METHOD,
    AsJson,
    EngineName,
    Force,
    MethodName,
    RayAddress,
    Resume,
    Settings,
    Threads,
    TileSize,
    Work,
)
from valuemap.cli.show import log, progress_bars, show, show_notes
from valuemap.cli.working import working
from valuemap.config import MapConfig
from valuemap.control import apply_control
from valuemap.dataset import Dataset, read_dataset, read_head
from valuemap.engine.choose import engine_named
from valuemap.errors import SettingError
from valuemap.evaluate import evaluate_map
from valuemap.evaluate.objects_file import check_objects_file, read_objects_file
from valuemap.evaluate.truth import read_objects
from valuemap.evidence import dataset_reference
from valuemap.folders import check_files, check_place, keep_input
from valuemap.map_folder import Map, write_map
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.report.above import draw_map
from valuemap.report.style import check_format
from valuemap.summary import summarize_map
from valuemap.writers.poses import check_poses_place, write_poses


@app.command("map", epilog="Settings for --set: see valuemap settings.")
def map_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that an import or simulate command wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write the map to.")],
    method: MethodName = DEFAULT_METHOD,
    threads: Threads = 0,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the map from above, as .png or .svg.")
    ] = None,
    write_poses_to: Annotated[
        Path | None,
        typer.Option(
            "--write-poses",
            metavar="OUT",
            help="Write the poses that the labels were found with, as a dataset and as a COLMAP model in OUT/colmap.",
        ),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(
            metavar="POINTS",
            help="Table of surveyed objects (x, y, z or lat, lon; height, sigma, class if known) to move the map to.",
        ),
    ] = None,
    tile_size: TileSize = None,
    engine: EngineName = "threads",
    ray_address: RayAddress = None,
    work: Work = None,
    resume: Resume = False,
    calibration: Annotated[
        Path | None, typer.Option(metavar="MAP", help="Take noise and rates from this map instead of estimating them.")
    ] = None,
    assignments: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Turn the detections of a dataset into a map of labels."""
    config = MapConfig(method=method).with_settings(assignments or [])
    if calibration is not None and method != "robust":  # A user would look for an effect that cannot be.
        raise SettingError(
            f"--calibration {calibration}: the method {method} has no such option, only robust has it",
            hint="leave it away, or use --method robust",
        )
    _check_places(dataset, out, picture, write_poses_to, force=force)
    if control is not None:
        check_objects_file(control, "control points")
        read_objects_file(control, read_head(dataset)[1])
    given = None if calibration is None else read_calibration(calibration)
    with working(work, out, resume=resume) as place, progress_bars() as progress:
        run = Run(
            place.folder,
            engine_named(engine, threads=threads, ray_address=ray_address),
            tile_size_m=tile_size,
            calibration=given,
            store=place.store,
        )
        result, cells = build_map_of_folder(dataset, config, run, progress=progress)
        if control is not None or write_poses_to is not None:
            data = result.corrected or read_dataset(dataset)
            if control is not None:
                result, data = _controlled(result, data, control)
            if write_poses_to is not None:
                write_poses(result, data, write_poses_to, force=force)
        result.run["dataset_folder"] = dataset_reference(write_poses_to or dataset, out)
        write_map(result, out, cells=cells, force=force)
    if picture is not None:
        data = read_dataset(write_poses_to or dataset)
        matches = evaluate_map(result, data).matches if data.truth is not None else None
        draw_map(result, data, matches, picture, force=force)
    show_notes(result.run["notes"])
    if as_json:
        print(json.dumps(result.run, indent=2))
    else:
        show(summarize_map(result))
        log.print(f"Wrote {out}", highlight=False)


def _check_places(dataset: Path, out: Path, picture: Path | None, write_poses_to: Path | None, *, force: bool) -> None:
    """Find out before long work whether all that is asked for can be written, and nothing that is read."""
    for folder in map_folder.PART_FOLDERS:  # What an older map has there gives way.
        keep_input(out / folder, dataset, "--out")
    check_place(out, parts=map_folder.PARTS, force=force)
    if picture is not None:
        check_format(picture)
        check_files(picture.parent, [picture.name], force=force)
    if write_poses_to is not None:
        if write_poses_to.resolve() == out.resolve():
            raise SettingError(
                f"--write-poses {write_poses_to}: is the folder of the map too", hint="give each a folder of its own"
            )
        keep_input(write_poses_to, dataset, "--write-poses")
        check_poses_place(write_poses_to, force=force)


def _controlled(result: Map, data: Dataset, control: Path) -> tuple[Map, Dataset]:
    """Return the map and its dataset moved to control points."""
    points = read_objects(control, result)
    result, moved = apply_control(result, points, data)
    assert moved is not None
    result.run["notes"] = [*result.run["notes"], *points.notes]
    return result, moved
