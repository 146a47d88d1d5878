"""`valuemap info`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from valuemap import dataset as dataset_folder
from valuemap import map_folder
from valuemap.cli.app import app
from valuemap.cli.options import AsJson
from valuemap.cli.show import show, show_notes
from valuemap.errors import InputError
from valuemap.folders import why_not_there
from valuemap.map_folder import read_map
from valuemap.portions import read_dataset_in_portions
from valuemap.summary import summarize_map, summarize_portions


@app.command("info")
def info_command(
    folder: Annotated[Path, typer.Argument(metavar="DATASET|MAP", help="Folder of a dataset or a map.")],
    as_json: AsJson = False,
) -> None:
    """Say what a dataset or a map holds, with the notes that were given when the map was made."""
    notes: list[str] = []
    if (folder / map_folder.MARKER).is_file():
        result = read_map(folder)
        notes = result.run.get("notes", [])
        facts = {**summarize_map(result), "notes": notes} if as_json else summarize_map(result)
    elif (folder / dataset_folder.MARKER).is_file():
        facts = summarize_portions(*read_dataset_in_portions(folder))
    else:
        raise InputError(
            f"{folder}: is neither a dataset nor a map"
            + ("" if folder.is_dir() else f": {why_not_there(folder, dataset_folder.MARKER)}"),
            hint=f"a dataset has a {dataset_folder.MARKER}, a map a {map_folder.MARKER}",
        )
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        show(facts)
    show_notes(notes)
