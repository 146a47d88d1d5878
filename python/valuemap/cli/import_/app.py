"""What all import commands end with."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import typer

from valuemap.cli.app import app
from valuemap.cli.show import log, show, show_notes
from valuemap.dataset import PARTS, Dataset, read_head, write_dataset
from valuemap.folders import check_place
from valuemap.portions import rows_on_disk
from valuemap.readers.vet import count_reasons
from valuemap.summary import summarize_dataset
from valuemap.tables import RejectedRows

_SHOWN_REJECTED = 10

import_app = typer.Typer(no_args_is_help=True, help="Bring posed images and detections into a dataset.")
app.add_typer(import_app, name="import")


def check_out(out: Path, *, force: bool) -> None:
    """Find out before the work whether a dataset can be written."""
    check_place(out, parts=PARTS, force=force)


def finish_dataset(dataset: Dataset, out: Path, *, force: bool, as_json: bool) -> None:
    """Write the dataset under the name of its folder, say on stdout what it holds, and on stderr what was left out."""
    dataset = replace(dataset, name=out.resolve().name)
    write_dataset(dataset, out, force=force)
    facts = summarize_dataset(dataset)
    if as_json:
        left_out = {} if dataset.rejected is None else count_reasons(dataset.rejected)
        print(json.dumps({**facts, "left_out": left_out}, indent=2))
    else:
        show(facts)
    if dataset.rejected is not None:
        show_notes(_rejected_lines(dataset.rejected, out))
    log.print(f"Wrote {out}", highlight=False)


def finish_dataset_of_pieces(out: Path, *, as_json: bool) -> None:
    """Say how large a dataset is that was written in pieces, as it may not fit into memory."""
    images, detections = rows_on_disk(out)
    facts = {"dataset": read_head(out)["name"], "images": images, "detections": detections}
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        show(facts)
    log.print(f"Wrote {out}", highlight=False)


def _rejected_lines(rejected: RejectedRows, out: Path) -> Iterator[str]:
    """Yield how many rows were left out, by reason, and the first of them."""
    for table, count in count_reasons(rejected).items():
        for reason, rows in count.items():
            yield f"left out of {table}: {rows}, because {reason}"
    for row in range(min(len(rejected), _SHOWN_REJECTED)):
        image = rejected.image_name[row].as_py()
        yield f"  {rejected.place[row].as_py()}: {rejected.reason.names[rejected.reason.codes[row]]} ({image})"
    yield f"all {len(rejected)} are in {out / 'rejected.parquet'}"
