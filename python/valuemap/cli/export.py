"""`valuemap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.show import log, show_notes
from valuemap.dataset import read_dataset
from valuemap.errors import InputError
from valuemap.evidence import find_dataset
from valuemap.map_folder import REVIEW, Map, read_map
from valuemap.review import apply_review, read_review
from valuemap.writers import WRITERS, export_map

_SHOWN_IDS = 10


@app.command("export", help=f"Write the labels of a map as one file: {', '.join(WRITERS)}.")
def export_command(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Folder that valuemap map wrote.")],
    file: Annotated[Path, typer.Argument(help="File to write; its suffix says the format.")],
    reviewed: Annotated[
        bool, typer.Option("--reviewed", help="Without rejected labels, with corrections, as decided in valuemap view.")
    ] = False,
    review: Annotated[
        Path | None, typer.Option(help="File of the decisions for --reviewed; default: review.json in the map.")
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="The dataset of the map, for --reviewed; default: found by itself, or not used.")
    ] = None,
) -> None:
    """Write the labels of a map as one file."""
    result = read_map(map_)
    if reviewed or review is not None:
        result = _reviewed(result, map_, review, dataset)
    export_map(result, file)
    log.print(f"Wrote {len(result.labels)} labels to {file}", highlight=False)


def _reviewed(result: Map, folder: Path, review: Path | None, dataset: Path | None) -> Map:
    path = review or folder / REVIEW
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="decide about labels with valuemap view, or give --review")
    found = find_dataset(folder, result.run, dataset)
    kept, outcome = apply_review(
        result, read_review(path, result.frame), None if found is None else read_dataset(found)
    )
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
