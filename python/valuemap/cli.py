"""The command line: the only place that parses arguments, prints and exits."""

from __future__ import annotations

import gc
import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
import typer.core
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBars
from rich.table import Table
from rich.text import Text

from valuemap import dataset as dataset_folder
from valuemap import map_folder
from valuemap.config import DetectConfig, MapConfig, Method, ModelKind, Provider, TrainConfig, describe_settings
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.errors import InputError, SettingError, ValuemapError
from valuemap.evaluate import Evaluation, evaluate_map
from valuemap.folders import check_place
from valuemap.map_folder import read_map, write_map
from valuemap.pipeline import build_map
from valuemap.progress import Progress
from valuemap.summary import summarize_dataset, summarize_map
from valuemap.writers import WRITERS, export_map

if TYPE_CHECKING:
    from valuemap.detect.accuracy import DetectionEvaluation

_INTERRUPTED = 130
_SHOWN_PROBLEMS = 5

_out = Console()
_log = Console(stderr=True)


class _Commands(typer.core.TyperGroup):
    """Commands whose errors come out as one line and a hint, and a status that is not 0."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except ValuemapError as error:
            _complain(f"error: {error}", error.hint)
            sys.exit(1)
        except KeyboardInterrupt:
            _complain("interrupted: nothing was written", "run the same command again to start over")
            sys.exit(_INTERRUPTED)


def _complain(message: str, hint: str) -> None:
    print(message, file=sys.stderr)
    print(f"hint: {hint}", file=sys.stderr)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    help="Many posed street images in, a 3D map of static objects out, with nobody labelling anything.",
)
import_app = typer.Typer(no_args_is_help=True, help="Bring posed images and detections into a dataset.")
app.add_typer(import_app, name="import")

DatasetOut = Annotated[Path, typer.Option("--out", help="Folder to write the dataset to.")]
Up = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--up", metavar="X Y Z", help="Direction of the sky; default: the mean of the cameras' own."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to stdout.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a setting; may be repeated.")
]


def main() -> None:
    """Run the command line."""
    gc.freeze()  # What was imported stays: looking through it for garbage, at the end too, takes a tenth of a second.
    app()


@import_app.command("colmap")
def import_colmap(
    model_dir: Annotated[Path, typer.Argument(help="Folder of a COLMAP model, .bin or .txt.")],
    out: DatasetOut,
    detections: Annotated[
        Path | None, typer.Option(help="COCO results or annotations (JSON); without, run valuemap detect afterwards.")
    ] = None,
    pass_from: Annotated[
        str, typer.Option(help="What a pass is: folder (of the image name), none, or a CSV file: image,pass.")
    ] = "folder",
    up: Up = None,
    anchor: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="LAT LON HEIGHT", help="WGS84 place of the origin of an east-north-up model."),
    ] = None,
) -> None:
    """Import a COLMAP model with detections in COCO format."""
    from valuemap.readers import READERS

    check_place(out, marker=dataset_folder.MARKER)
    with _progress_bars() as progress:
        dataset = READERS["colmap"](
            model_dir, detections=detections, pass_from=pass_from, up=up, anchor=anchor, progress=progress
        )
    _finish_dataset(dataset, out)


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
) -> None:
    """Import KITTI-odometry-style poses with boxes in a CSV file."""
    from valuemap.readers import READERS

    check_place(out, marker=dataset_folder.MARKER)
    with _progress_bars() as progress:
        dataset = READERS["kitti"](
            poses,
            intrinsics=intrinsics,
            image_size=image_size,
            detections=detections,
            class_name=class_name,
            up=up,
            progress=progress,
        )
    _finish_dataset(dataset, out)


@app.command("simulate")
def simulate_command(
    out: DatasetOut,
    preset: Annotated[str, typer.Option(help="small, sf or nyc: the sizes of the paper's two data sets.")] = "small",
    seed: Annotated[int, typer.Option(help="Another seed, another city.")] = 0,
    images: Annotated[
        bool, typer.Option("--images", help="Draw the pictures too, with the true boxes in boxes.json.")
    ] = False,
    assignments: Settings = None,
) -> None:
    """Simulate a city, drives through it and a noisy detector, with truth."""
    from valuemap.simulate import PRESETS, record_city

    if preset not in PRESETS:
        raise SettingError(f"--preset {preset}: there is no such preset", hint=f"choose one of {', '.join(PRESETS)}")
    check_place(out, marker=dataset_folder.MARKER)
    config = PRESETS[preset].with_settings(assignments or [])
    with _progress_bars() as progress:
        recording = record_city(config, seed=seed, name=preset, progress=progress)
    _finish_dataset(recording.dataset, out)
    if images:
        from valuemap.simulate.render import render_images  # Draws with a library that nothing else here needs.

        try:
            with _progress_bars() as progress:
                painted = render_images(recording, out, progress=progress)
        except KeyboardInterrupt:
            _complain("interrupted: the dataset is whole, its pictures are not", "run the same command again")
            sys.exit(_INTERRUPTED)
        _log.print(f"Drew {painted} pictures in {out / 'images'}", highlight=False)


@app.command("detect", epilog="Settings for --set: tile_overlap_px, max_iou, decoders, panorama_view_deg and more.")
def detect_command(
    place: Annotated[Path, typer.Argument(metavar="DATASET|FOLDER", help="A dataset, or any folder of pictures.")],
    model: Annotated[Path, typer.Option(help="ONNX file; or bundled, a small model for traffic lights.")],
    classes: Annotated[
        str, typer.Option(help='Wanted classes, "traffic light,stop sign"; numbers too, and new names: "9=light".')
    ] = DetectConfig.classes,
    min_score: Annotated[float | None, typer.Option(help="Drop boxes with a lower score.")] = None,
    size: Annotated[
        str, typer.Option(help="What the network sees: model (its own), picture, N or WIDTHxHEIGHT in px.")
    ] = DetectConfig.size,
    tile: Annotated[int, typer.Option(help="Cut larger pictures into overlapping tiles, px; 0 for none.")] = 0,
    batch: Annotated[int, typer.Option(help="Pictures that go through the network together.")] = 1,
    provider: Annotated[str, typer.Option(help=f"One of {', '.join(get_args(Provider))}.")] = DetectConfig.provider,
    kind: Annotated[str | None, typer.Option(help=f"What the outputs mean: {', '.join(get_args(ModelKind))}.")] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of the pictures of a dataset; default: images in it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Where the results of a folder of pictures go; default: into it.")
    ] = None,
    assignments: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Find objects in pictures with an ONNX model; started again, an interrupted run goes on."""
    from valuemap.detect import BUNDLED_MODEL
    from valuemap.detect.run import RECORD, detect_dataset, detect_folder  # ONNX Runtime and OpenCV.

    if str(model) == "bundled":
        model = BUNDLED_MODEL
    config = DetectConfig(
        kind=kind,  # type: ignore[arg-type]
        classes=classes,
        size=size,
        provider=provider,  # type: ignore[arg-type]
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
    try:
        with _progress_bars() as progress:
            if is_dataset:
                detect_dataset(place, model, config, pictures=images, progress=progress)
            else:
                detect_folder(place, model, config, out=out, progress=progress)
    except KeyboardInterrupt:
        _complain("interrupted: the detections are as before", "run the same command again to go on from here")
        sys.exit(_INTERRUPTED)
    record = json.loads(((out or place) / RECORD).read_text(encoding="utf-8"))
    if as_json:
        print(json.dumps(record, indent=2))
        return
    counts, found = record["counts"], record["counts"].pop("detections_of_class")
    _show(
        {
            **{name.replace("_", " "): value for name, value in counts.items()},
            "classes": ", ".join(f"{name} {number}" for name, number in found.items()),
            "pictures a second": record["pictures_a_second"] or "-",
        }
    )
    for unusable in record["unusable"][:_SHOWN_PROBLEMS]:
        print(f"note: {unusable['image']}: {unusable['problem']}", file=sys.stderr)
    if len(record["unusable"]) > _SHOWN_PROBLEMS:
        print(f"note: all {len(record['unusable'])} are listed in {(out or place) / RECORD}", file=sys.stderr)


@app.command("train")
def train_command(
    data: Annotated[
        list[str], typer.Option(help="Labelled pictures: bosch:FILE, yolo:DIR or coco:FILE; may be repeated.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for checkpoints, metrics and the model.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last epoch of an interrupted run.")] = False,
    one_class: Annotated[str | None, typer.Option("--class", help="Take every label as this one class.")] = None,
    seed: Annotated[int, typer.Option(help="Of the first weights, the split and all variation.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="Threads of the network, 0 as PyTorch chooses.")] = 0,
    assignments: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train a network on labelled pictures; needs the extra named train."""
    from valuemap.detect.labels import read_labels
    from valuemap.detect.train import train

    config = TrainConfig().with_settings(assignments or [])
    try:
        with _progress_bars() as progress:
            labels = [read_labels(source) for source in data]
            result = train(
                labels,
                out,
                config,
                resume=resume,
                one_class=one_class,
                seed=seed,
                threads=threads,
                progress=progress,
            )
    except KeyboardInterrupt:
        _complain("interrupted: all finished epochs are kept", "go on with the same command and --resume")
        sys.exit(_INTERRUPTED)
    facts = {**asdict(result), "model": str(result.model)}
    skipped, counts = facts.pop("skipped"), facts.pop("counts")
    if as_json:
        print(json.dumps({**facts, "counts": counts, "skipped": skipped}, indent=2))
        return
    _show({**{name.replace("_", " "): value for name, value in counts.items()}, **facts})
    for line in skipped[:_SHOWN_PROBLEMS]:
        print(f"note: {line}", file=sys.stderr)
    if len(skipped) > _SHOWN_PROBLEMS:
        print(f"note: {len(skipped)} pictures or labels were left out", file=sys.stderr)


@app.command("evaluate-detections")
def evaluate_detections_command(
    place: Annotated[
        Path, typer.Argument(metavar="DATASET|FOLDER", help="A dataset, or a folder that valuemap detect looked at.")
    ],
    labels: Annotated[str, typer.Option(help="Labelled pictures: bosch:FILE, yolo:DIR or coco:FILE.")],
    min_score: Annotated[float, typer.Option(help="For recall and precision, count boxes of at least this.")] = 0.0,
    min_height: Annotated[float, typer.Option(help="Count only objects of at least this height, px.")] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Compare detections with labelled pictures: recall, precision and average precision, by box height."""
    from valuemap.detect.accuracy import evaluate_boxes
    from valuemap.detect.found import match_pictures, read_found
    from valuemap.detect.labels import read_labels

    found, known = read_found(place), read_labels(labels)
    evaluation = evaluate_boxes(match_pictures(found, known), known, min_score=min_score, min_height_px=min_height)
    if as_json:
        print(json.dumps(evaluation.to_json(), indent=2))
    else:
        _show_accuracies(evaluation)
    for note in evaluation.notes:
        print(f"note: {note}", file=sys.stderr)


@app.command("map", epilog="Settings for --set: see valuemap settings.")
def map_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that an import or simulate command wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write the map to.")],
    method: Annotated[str, typer.Option(help=f"One of {', '.join(get_args(Method))}.")] = MapConfig().method,
    threads: Annotated[int, typer.Option(min=0, help="Threads, 0 for one a core; the map is the same.")] = 0,
    assignments: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Turn the detections of a dataset into a map of labels."""
    config = MapConfig(method=method).with_settings(assignments or [])  # type: ignore[arg-type]
    check_place(out, marker=map_folder.MARKER)
    with _progress_bars() as progress:
        result = build_map(read_dataset(dataset), config, threads=threads, progress=progress)
    write_map(result, out)
    if as_json:
        print(json.dumps(result.run, indent=2))
    else:
        _show(summarize_map(result))
        _log.print(f"Wrote {out}", highlight=False)


@app.command("evaluate")
def evaluate_command(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Folder that valuemap map wrote.")],
    truth: Annotated[Path, typer.Option(help="A dataset with truth, or a file of objects with x, y, z.")],
    radius: Annotated[float, typer.Option(help="Metres within which a label can be an object.")] = 2.0,
    as_json: AsJson = False,
) -> None:
    """Compare a map with known objects."""
    evaluation = evaluate_map(read_map(map_), truth, radius_m=radius)
    if as_json:
        print(json.dumps(evaluation.to_json(), indent=2))
    else:
        _show(_evaluation_rows(evaluation))
    for note in evaluation.notes:
        print(f"note: {note}", file=sys.stderr)


@app.command("export", help=f"Write the labels of a map as one file: {', '.join(WRITERS)}.")
def export_command(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Folder that valuemap map wrote.")],
    file: Annotated[Path, typer.Argument(help="File to write; its suffix says the format.")],
) -> None:
    """Write the labels of a map as one file."""
    result = read_map(map_)
    export_map(result, file)
    _log.print(f"Wrote {len(result.labels)} labels to {file}", highlight=False)


@app.command("info")
def info_command(
    folder: Annotated[Path, typer.Argument(metavar="DATASET|MAP", help="Folder of a dataset or a map.")],
    as_json: AsJson = False,
) -> None:
    """Say what a dataset or a map holds."""
    if (folder / map_folder.MARKER).is_file():
        facts = summarize_map(read_map(folder))
    elif (folder / dataset_folder.MARKER).is_file():
        facts = summarize_dataset(read_dataset(folder))
    else:
        raise InputError(
            f"{folder}: is neither a dataset nor a map",
            hint=f"a dataset has a {dataset_folder.MARKER}, a map a {map_folder.MARKER}",
        )
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        _show(facts)


@app.command("settings")
def settings_command() -> None:
    """List the settings of the method for --set, with units and effects."""
    table = Table("setting", "default", "unit", "effect")
    for row in describe_settings():
        table.add_row(*row)
    _out.print(table)


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for dataset, map and picture.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another city.")] = 0,
) -> None:
    """Simulate a city, draw its pictures, detect lights in them, map these, evaluate and draw the map."""
    from valuemap.demo import run_demo

    check_place(out / "dataset", marker=dataset_folder.MARKER)
    check_place(out / "map", marker=map_folder.MARKER)
    with _progress_bars() as progress:
        outcome = run_demo(out, seed=seed, progress=progress)
    _show(summarize_dataset(outcome.dataset), title="A simulated city and what was detected in its pictures")
    _show(_detection_rows(outcome.detection), title="The detections")
    _show(summarize_map(outcome.result), title="The map of them")
    _show(_evaluation_rows(outcome.evaluation), title="The map against the simulated truth")
    for what, path in outcome.files.items():
        _out.print(f"{what:8} {path}", highlight=False, soft_wrap=True)


def _finish_dataset(dataset: Dataset, out: Path) -> None:
    write_dataset(dataset, out)
    _show(summarize_dataset(dataset), console=_log)
    _log.print(f"Wrote {out}", highlight=False)


def _show_accuracies(evaluation: DetectionEvaluation) -> None:
    """Print one line for each range of heights and each IoU."""
    table = Table(box=None)
    for name in ("height px", "IoU", "labels", "recall", "precision", "AP", "mean IoU", "best F1", "at score"):
        table.add_column(name, justify="right", no_wrap=True)
    everything = f"{evaluation.min_height_px:g} up" if evaluation.min_height_px else "all"
    ranges = {everything: evaluation.overall}
    for (low, high), each in evaluation.by_height.items():
        ranges[f"{low:g} up" if math.isinf(high) else f"{low:g} to {high:g}"] = each
    for heights, each in ranges.items():
        for iou, accuracy in each.items():
            figures = (
                accuracy.recall,
                accuracy.precision,
                accuracy.average_precision,
                accuracy.mean_iou,
                accuracy.best_f1,
                accuracy.best_score,
            )
            shown = ("-" if math.isnan(figure) else f"{figure:.3f}" for figure in figures)
            table.add_row(heights, f"{iou:g}", str(accuracy.labels), *shown)
    _out.print(table)


def _detection_rows(evaluation: DetectionEvaluation) -> dict[str, Any]:
    """Return how good detections are in pictures, at the lowest IoU."""
    iou, accuracy = next(iter(evaluation.overall.items()))
    return {
        "pictures": evaluation.pictures,
        "true boxes": accuracy.labels,
        f"recall at IoU {iou:g}": accuracy.recall,
        f"precision at IoU {iou:g}": accuracy.precision,
        "mean IoU": accuracy.mean_iou,
    }


def _evaluation_rows(evaluation: Evaluation) -> dict[str, Any]:
    """Return the measures with what they are measured against, for people."""
    return {
        "labels": evaluation.labels,
        "true objects": evaluation.objects,
        "recoverable objects": evaluation.recoverable_objects,
        **evaluation.to_json(),
    }


def _show(facts: dict[str, Any], *, title: str | None = None, console: Console = _out) -> None:
    """Print facts as two columns; nested ones as name.key."""
    table = Table(show_header=False, box=None, title=title, title_justify="left", title_style="bold")
    table.add_column(no_wrap=True)
    table.add_column(justify="right")
    for name, value in facts.items():
        table.add_row(name, f"{value:.3f}" if isinstance(value, float) else str(value))
    console.print(table)


class _SpeedColumn(ProgressColumn):
    """How much gets done a second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


@contextmanager
def _progress_bars() -> Iterator[Progress]:
    """Yield a callback that draws one bar for each kind of work on stderr, if that is a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _SpeedColumn(),
        TimeRemainingColumn(),
    )
    with ProgressBars(*columns, console=_log, transient=True, disable=not _log.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def progress(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what)
            bars.update(tasks[what], completed=done, total=total)

        yield progress
