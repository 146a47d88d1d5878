"""What all import commands end with."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from valuemap.cli.app import app
from valuemap.cli.show import log, show, show_notes
from valuemap.dataset import PARTS, Dataset, read_head, write_dataset
from valuemap.folders import check_place
from valuemap.portions import ROWS, read_portions, rows_on_disk
from valuemap.readers.assemble import Imported
from valuemap.readers.vet import Rejections
from valuemap.summary import summarize_dataset, summarize_portions
from valuemap.tables import Detections

_SHOWN_REJECTED = 10

import_app = typer.Typer(no_args_is_help=True, help="Bring posed images and detections into a dataset.")
app.add_typer(import_app, name="import")


def check_out(out: Path, *, force: bool) -> None:
    """Find out before the work whether a dataset can be written."""
    check_place(out, parts=PARTS, force=force)


def finish_import(found: Imported, out: Path, *, force: bool, as_json: bool) -> None:
    """Write the dataset under the name of its folder, say on stdout what it holds, and on stderr what was left out."""
    found.write(out, force=force)
    named = replace(found.dataset, name=out.resolve().name)
    facts = summarize_portions(named, read_portions(Detections, out / "detections.parquet", ROWS))
    _say(facts, found.left_out.counts(), as_json=as_json)
    if len(found.left_out):
        show_notes(_rejected_lines(found.left_out, out))
    log.print(f"Wrote {out}", highlight=False)


def finish_dataset(dataset: Dataset, out: Path, *, force: bool, as_json: bool) -> None:
    """Write a dataset that is in memory under the name of its folder, and say on stdout what it holds."""
    dataset = replace(dataset, name=out.resolve().name)
    write_dataset(dataset, out, force=force)
    _say(summarize_dataset(dataset), {}, as_json=as_json)
    log.print(f"Wrote {out}", highlight=False)


def _say(facts: Mapping[str, Any], left_out: Mapping[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({**facts, "left_out": left_out}, indent=2))
    else:
        show(facts)


def finish_dataset_of_pieces(out: Path, *, as_json: bool) -> None:
    """Say how large a dataset is that was written in pieces, as it may not fit into memory."""
    images, detections = rows_on_disk(out)
    facts = {"dataset": read_head(out)[0], "images": images, "detections": detections}
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        show(facts)
    log.print(f"Wrote {out}", highlight=False)


def _rejected_lines(left_out: Rejections, out: Path) -> Iterator[str]:
    """Yield how many rows were left out, by reason, and the first of them."""
    for table, count in left_out.counts().items():
        for reason, rows in count.items():
            yield f"left out of {table}: {rows}, because {reason}"
    shown = 0
    for portion in left_out.portions():
        for row in range(min(len(portion), _SHOWN_REJECTED - shown)):
            image, reason = portion.image_name[row].as_py(), portion.reason.names[portion.reason.codes[row]]
            yield f"  {portion.place[row].as_py()}: {reason} ({image})"
        shown += len(portion)
        if shown >= _SHOWN_REJECTED:
            break
    yield f"all {len(left_out)} are in {out / 'rejected.parquet'}"
