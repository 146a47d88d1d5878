"""`valuemap settings`."""

from __future__ import annotations

import json

from rich.table import Table

from valuemap.cli.app import app
from valuemap.cli.options import AsJson
from valuemap.cli.show import out
from valuemap.config import describe_settings, list_settings


@app.command("settings")
def settings_command(as_json: AsJson = False) -> None:
    """List the settings of the method for --set, with units and effects."""
    if as_json:
        print(json.dumps(list_settings(), indent=2))
        return
    table = Table("setting", "default", "unit", "effect")
    for row in describe_settings():
        table.add_row(*row)
    out.print(table)
