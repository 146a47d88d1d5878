"""The command line: the only place that parses arguments, prints and exits. One file a command."""

from __future__ import annotations

from valuemap.cli.signals import end_at_once, end_in_order


def main() -> None:
    """Run the command line."""
    with end_at_once():
        import gc
        import sys

        from valuemap.cli.app import app
        from valuemap.cli.load import load_commands

        load_commands(sys.argv[1:])
        for stream in (sys.stdout, sys.stderr):  # Names of files need not be UTF-8.
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        gc.freeze()  # What was imported stays: looking through it for garbage, at the end too, takes 0.1 s.
    end_in_order()
    app()
