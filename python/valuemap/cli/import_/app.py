"""What all import commands end with."""

from __future__ import annotations

from pathlib import Path

import typer

from valuemap.cli.app import app
from valuemap.cli.show import log, show
from valuemap.dataset import Dataset, write_dataset
from valuemap.summary import summarize_dataset

import_app = typer.Typer(no_args_is_help=True, help="Bring posed images and detections into a dataset.")
app.add_typer(import_app, name="import")


def finish_dataset(dataset: Dataset, out: Path) -> None:
    """Write the dataset and say on stderr what it holds."""
    write_dataset(dataset, out)
    show(summarize_dataset(dataset), console=log)
    log.print(f"Wrote {out}", highlight=False)
