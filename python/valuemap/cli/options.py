"""Options that several commands have in common."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from valuemap.config import MapConfig, Method
from valuemap.errors import SettingError


def checked(module: str, name: str) -> Callable[[Any], Any]:
    """Return a callback of an option: what a function, which is only then imported, refuses is a wrong use of it."""

    def check(value: Any) -> Any:
        if value is not None:
            try:
                getattr(import_module(f"valuemap.{module}"), name)(value)
            except SettingError as error:
                raise typer.BadParameter(f"{error} ({error.hint})") from error
        return value

    return check


MapFolder = Annotated[Path, typer.Argument(metavar="MAP", help="Folder that valuemap map wrote.")]
DatasetOfMap = Annotated[
    Path | None, typer.Option("--dataset", help="What the map was made from; default: where valuemap map found it.")
]
TruthSigma = Annotated[
    float | None,
    typer.Option(
        "--truth-sigma",
        metavar="M",
        callback=checked("evaluate.accuracy", "check_truth_sigma"),
        help="Standard deviation of the true positions on each axis, in metres.",
    ),
]
SeenWithin = Annotated[
    float | None,
    typer.Option(
        "--seen-within",
        metavar="M",
        callback=checked("evaluate.evaluation", "check_seen_within"),
        help="Objects farther than this from every image do not count.",
    ),
]
Radius = Annotated[
    float,
    typer.Option(
        "--radius",
        callback=checked("evaluate.matching", "check_radius"),
        help="Metres within which a label can be an object.",
    ),
]
Threads = Annotated[int, typer.Option("--threads", min=0, help="Threads, 0 for one per core; the map is the same.")]
DatasetOut = Annotated[Path, typer.Option("--out", help="Folder to write the dataset to.")]
Up = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--up", metavar="X Y Z", help="Direction of the sky; default: the mean of the cameras' own."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to stdout.")]
MethodName = Annotated[Method, typer.Option(help="The published method, or the one that goes beyond it.")]
DEFAULT_METHOD = MapConfig().method
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a setting; may be repeated.")
]
MaxRejected = Annotated[
    float,
    typer.Option(
        "--max-rejected",
        metavar="SHARE",
        min=0.0,
        max=1.0,
        help="Stop where more of the boxes, or images, cannot be used.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace files that valuemap did not write, too.")]
TileSize = Annotated[
    float | None,
    typer.Option(
        "--tile-size",
        metavar="METRES",
        callback=checked("tiles.grid", "check_tile_size"),
        help="Cut the dataset on disk into tiles of about this size; the map is the same. "
        "Default: only where it is larger than memory, as small as can be.",
    ),
]
Work = Annotated[
    str | None,
    typer.Option(
        "--work",
        metavar="FOLDER|URL",
        help="Where unfinished parts are kept: a folder, or a place in a store (s3://bucket/run). "
        "Default: beside --out, named .work.",
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with what an interrupted run has left.")]
Vertical = Annotated[
    str | None,
    typer.Option(
        "--vertical",
        metavar="EPSG|METRES",
        help="What heights count from: a system, EPSG:5773, or how many metres above the ellipsoid its zero is.",
    ),
]
EngineName = Annotated[
    Literal["threads", "ray"],
    typer.Option("--engine", help="threads: on this machine; ray: on a cluster, see docs/cluster.md."),
]
RayAddress = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Cluster for --engine ray, as host:port. Default: one on this machine."),
]
