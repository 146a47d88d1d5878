"""`valuemap report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.options import DatasetOfMap, Force, MapFolder, Radius, SeenWithin, TruthSigma
from valuemap.cli.show import log, progress_bars
from valuemap.dataset import read_dataset
from valuemap.errors import OutputError
from valuemap.evaluate import evaluate_map
from valuemap.evidence import find_dataset
from valuemap.map_folder import read_map
from valuemap.tiles.part import is_large, part_of_map


@app.command("report")
def report_command(
    map_: MapFolder,
    out: Annotated[Path, typer.Option("--out", help="HTML file; figures and tables go into a folder beside it.")],
    dataset: DatasetOfMap = None,
    truth: Annotated[
        Path | None, typer.Option(help="A dataset with truth, or a file of objects; default: the dataset's own truth.")
    ] = None,
    passes: Annotated[
        Path | None, typer.Option(help="What valuemap experiment passes wrote: recall and errors by number of passes.")
    ] = None,
    force: Force = False,
    radius: Radius = 2.0,
    truth_sigma: TruthSigma = None,
    seen_within: SeenWithin = None,
) -> None:
    """Make one page of everything about a map: labels to click, figures, tables. It needs no network and no server."""
    from valuemap.experiment import read_passes
    from valuemap.report.write import files_folder, write_report  # Draws with a library that is slow to import.

    if out.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{out}: a report is an HTML file", hint="name a file that ends in .html")
    result = read_map(map_)
    folder = find_dataset(map_, result.run, dataset)
    is_part = folder is not None and is_large(folder)
    data = None
    if folder is not None and is_part:
        result, data = part_of_map(result, folder)
    elif folder is not None:
        data = read_dataset(folder)
    known = truth if truth is not None else data if data is not None and data.truth is not None else None
    evaluation = None
    if known is not None and not is_part:
        evaluation = evaluate_map(
            result,
            known,
            radius_m=radius,
            truth_sigma_m=truth_sigma,
            images=None if seen_within is None else data,
            seen_within_m=seen_within,
        )
    curves = None if passes is None else read_passes(passes)
    with progress_bars() as progress:
        write_report(
            result,
            out,
            dataset=data,
            dataset_folder=folder,
            evaluation=evaluation,
            passes=curves,
            force=force,
            progress=progress,
        )
    log.print(f"Wrote {out}, its figures and tables to {files_folder(out)}", highlight=False, markup=False)
