"""`valuemap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.show import log
from valuemap.map_folder import read_map
from valuemap.writers import WRITERS, export_map


@app.command("export", help=f"Write the labels of a map as one file: {', '.join(WRITERS)}.")
def export_command(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Folder that valuemap map wrote.")],
    file: Annotated[Path, typer.Argument(help="File to write; its suffix says the format.")],
) -> None:
    """Write the labels of a map as one file."""
    result = read_map(map_)
    export_map(result, file)
    log.print(f"Wrote {len(result.labels)} labels to {file}", highlight=False)
