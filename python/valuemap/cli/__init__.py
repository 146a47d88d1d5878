"""The command line: the only place that parses arguments, prints and exits. One file a command."""

from __future__ import annotations


def main() -> None:
    """Run the command line."""
    import gc

    from valuemap.cli.commands import app

    gc.freeze()  # What was imported stays: looking through it for garbage, at the end too, takes a tenth of a second.
    app()
