"""`valuemap settings`."""

from __future__ import annotations

from rich.table import Table

from valuemap.cli.app import app
from valuemap.cli.show import out
from valuemap.config import describe_settings


@app.command("settings")
def settings_command() -> None:
    """List the settings of the method for --set, with units and effects."""
    table = Table("setting", "default", "unit", "effect")
    for row in describe_settings():
        table.add_row(*row)
    out.print(table)
