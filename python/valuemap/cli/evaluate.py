"""`valuemap evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.options import AsJson
from valuemap.cli.show import evaluation_rows, show, show_notes
from valuemap.evaluate import evaluate_map
from valuemap.map_folder import read_map


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
        show(evaluation_rows(evaluation))
    show_notes(evaluation.notes)
