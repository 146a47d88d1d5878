"""`valuemap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from valuemap.cli.app import app
from valuemap.cli.options import Force, MapFolder, Vertical
from valuemap.cli.show import log, show_notes
from valuemap.dataset import Dataset, read_dataset, rows_of_votes
from valuemap.errors import InputError
from valuemap.evidence import find_dataset
from valuemap.map_folder import REVIEW, Map, read_map
from valuemap.review import apply_review, read_review
from valuemap.writers import SUFFIXES, export_map, without_password

Format = Literal[
    "csv", "geojson", "parquet", "gpkg", "fgb", "kml", "osm", "maproulette", "lanelet2", "xodr", "rerun", "colmap"
]

_SHOWN_IDS = 10


@app.command(
    "export", help=f"Write the labels of a map as one file ({', '.join(SUFFIXES)}) or into PostGIS (postgresql://...)."
)
def export_command(
    map_: MapFolder,
    target: Annotated[
        str, typer.Argument(metavar="FILE|URL", help="File to write, whose suffix says the format, or a database.")
    ],
    format_name: Annotated[Format | None, typer.Option("--format", help="The format, whatever the suffix.")] = None,
    crs: Annotated[
        str | None, typer.Option(help="Reference system to write in, such as EPSG:25832; default: WGS84.")
    ] = None,
    vertical: Vertical = None,
    reviewed: Annotated[
        bool, typer.Option("--reviewed", help="Without rejected labels, with corrections, as decided in valuemap view.")
    ] = False,
    review: Annotated[
        Path | None, typer.Option(help="File of the decisions for --reviewed; default: review.json in the map.")
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(help="The dataset of the map, for pictures, cameras and --reviewed; default: found by itself."),
    ] = None,
    force: Force = False,
) -> None:
    """Write the labels of a map as one file or into a database."""
    result = read_map(map_)
    known = _dataset(map_, result, dataset)
    if reviewed or review is not None:
        result = _reviewed(result, map_, review, known)
    notes = list(map(str, result.run.get("notes", [])))  # Who has the file only knows nothing of run.json.
    count = export_map(
        result,
        target,
        format_name=format_name,
        dataset=known,
        crs=crs,
        vertical=vertical,
        force=force,
        tell=notes.append,
    )
    show_notes(dict.fromkeys(notes))
    log.print(f"Wrote {count} labels to {without_password(target)}", highlight=False)


def _dataset(map_: Path, result: Map, given: Path | None) -> Dataset | None:
    """Return the dataset of a map: the given one, else one that is found, if it is the map's by name and votes."""
    folder = find_dataset(map_, result.run, given)
    if folder is None:
        return None
    dataset = read_dataset(folder)
    if given is None and dataset.name != result.run.get("dataset"):
        return None
    try:
        rows_of_votes(result.votes, dataset)
    except InputError as error:
        if given is not None:
            raise
        show_notes([f"the dataset {folder.name} cannot be used for pictures and cameras: {error}"])
        return None
    return dataset


def _reviewed(result: Map, folder: Path, review: Path | None, dataset: Dataset | None) -> Map:
    path = review or folder / REVIEW
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="decide about labels with valuemap view, or give --review")
    kept, outcome = apply_review(result, read_review(path, result.frame), dataset)
    notes = [f"{outcome.accepted} labels accepted, {outcome.rejected} rejected and left out"]
    if outcome.check_again:
        ids = ", ".join(map(str, outcome.check_again[:_SHOWN_IDS]))
        more = f" and {len(outcome.check_again) - _SHOWN_IDS} more" if len(outcome.check_again) > _SHOWN_IDS else ""
        notes.append(
            f"{len(outcome.check_again)} rejected labels have twice the votes now and are left out: please check again "
            f"in valuemap view: {ids}{more}"
        )
    if outcome.without_label:
        notes.append(f"{outcome.without_label} decisions are about nothing in this map")
    show_notes(notes)
    return kept
