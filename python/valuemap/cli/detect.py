"""`valuemap detect`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from valuemap import dataset as dataset_folder
from valuemap.cli.app import app, on_interrupt
from valuemap.cli.options import AsJson, EngineName, Force, RayAddress, Settings
from valuemap.cli.show import SHOWN_PROBLEMS, progress_bars, show
from valuemap.config import DetectConfig, ModelKind, Provider
from valuemap.engine.choose import engine_named
from valuemap.errors import SettingError


@app.command("detect", epilog="Settings for --set: tile_overlap_px, max_iou, decoders, panorama_view_deg and more.")
def detect_command(
    place: Annotated[Path, typer.Argument(metavar="DATASET|FOLDER", help="A dataset, or any folder of pictures.")],
    model: Annotated[Path, typer.Option(help="ONNX file; or bundled, a small model for traffic lights.")],
    classes: Annotated[
        str, typer.Option(help='Wanted classes, "traffic light,stop sign"; numbers too, and new names: "9=light".')
    ] = DetectConfig.classes,
    min_score: Annotated[float | None, typer.Option(min=0.0, max=1.0, help="Drop boxes with a lower score.")] = None,
    size: Annotated[
        str, typer.Option(help="What the network sees: model (its own), picture, N or WIDTHxHEIGHT in px.")
    ] = DetectConfig.size,
    tile: Annotated[int, typer.Option(help="Cut larger pictures into overlapping tiles, px; 0 for none.")] = 0,
    batch: Annotated[int, typer.Option(help="Pictures that go through the network together.")] = 1,
    provider: Annotated[Provider, typer.Option(help="What the network runs on.")] = DetectConfig.provider,
    kind: Annotated[ModelKind | None, typer.Option(help="What the outputs mean; default: found out.")] = None,
    images: Annotated[
        str | None,
        typer.Option(metavar="FOLDER|URL", help="Where the pictures of a dataset are; default: images in it."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Where the results of a folder of pictures go; default: into it.")
    ] = None,
    engine: EngineName = "threads",
    ray_address: RayAddress = None,
    assignments: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find objects in pictures with an ONNX model; started again, an interrupted run goes on."""
    from valuemap.detect import BUNDLED_MODEL
    from valuemap.detect.run import RECORD, detect_dataset, detect_folder  # ONNX Runtime and OpenCV.

    if str(model) == "bundled":
        model = BUNDLED_MODEL
    config = DetectConfig(
        kind=kind,
        classes=classes,
        size=size,
        provider=provider,
        min_score=min_score,
        tile_px=tile,
        batch=batch,
    ).with_settings(assignments or [])
    is_dataset = (place / dataset_folder.MARKER).is_file()
    if (out if is_dataset else images) is not None:
        raise SettingError(
            "--out is for folders of pictures, --images for datasets",
            hint="a dataset gets its detections, a folder of pictures detections.json",
        )
    state, hint = "the detections are as before", "run the same command again to go on from here"
    with on_interrupt(state, hint), progress_bars() as progress:
        where = engine_named(engine, ray_address=ray_address)
        if is_dataset:
            detect_dataset(place, model, config, pictures=images, engine=where, force=force, progress=progress)
        else:
            detect_folder(place, model, config, out=out, engine=where, force=force, progress=progress)
    record = json.loads(((out or place) / RECORD).read_text(encoding="utf-8"))
    if as_json:
        print(json.dumps(record, indent=2))
        return
    counts, found = record["counts"], record["counts"].pop("detections_of_class")
    show(
        {
            **{name.replace("_", " "): value for name, value in counts.items()},
            "classes": ", ".join(f"{name} {number}" for name, number in found.items()),
            "pictures per second": record["pictures_a_second"] or "-",
        }
    )
    if not counts["detections"]:
        print(
            f"note: nothing was found with min_score {record['settings']['min_score']:g} by a model of kind "
            f"{record['model_kind']}: --classes, --min-score, --kind and --size say what is looked for, and how",
            file=sys.stderr,
        )
    for unusable in record["unusable"][:SHOWN_PROBLEMS]:
        print(f"note: {unusable['image']}: {unusable['problem']}", file=sys.stderr)
    if len(record["unusable"]) > SHOWN_PROBLEMS:
        print(f"note: all {len(record['unusable'])} are listed in {(out or place) / RECORD}", file=sys.stderr)
