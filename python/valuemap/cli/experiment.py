"""`valuemap experiment passes`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from valuemap.cli import show as shown
from valuemap.cli.app import app, on_interrupt
from valuemap.cli.options import DEFAULT_METHOD, AsJson, MethodName, Radius, Settings
from valuemap.cli.show import log, progress_bars
from valuemap.config import MapConfig
from valuemap.dataset import read_dataset

experiment_app = typer.Typer(no_args_is_help=True, help="Measure on your own data what the paper measures on its.")
app.add_typer(experiment_app, name="experiment")


@experiment_app.command("passes")
def passes_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that an import or simulate command wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the result; an interrupted experiment goes on there.")],
    seeds: Annotated[int, typer.Option(min=1, help="Random orders of the passes.")] = 5,
    min_passes: Annotated[int, typer.Option(min=2, help="Clusters with fewer passes do not count.")] = 5,
    radius: Radius = 2.0,
    method: MethodName = DEFAULT_METHOD,
    threads: Annotated[int, typer.Option(min=0, help="Threads, 0 for one per core; the result is the same.")] = 0,
    assignments: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Measure recall, reprojection error and position error against the number of passes, as in the paper's Fig. 4."""
    from valuemap.experiment import CURVES, experiment_passes

    config = MapConfig(method=method).with_settings(assignments or [])
    state, hint = "all finished maps are kept", "run the same command again to go on from here"
    with on_interrupt(state, hint), progress_bars() as progress:
        result = experiment_passes(
            read_dataset(dataset),
            out,
            config,
            seeds=seeds,
            min_passes=min_passes,
            radius_m=radius,
            threads=threads,
            progress=progress,
        )
    if as_json:
        print(json.dumps(result.to_json(), indent=2))
        return
    table = Table(box=None)
    for name in ("measure", "passes", "clusters", "lower quartile", "median", "upper quartile"):
        table.add_column(name, justify="left" if name == "measure" else "right", no_wrap=True)
    for name, curve in result.curves.items():
        title, unit = CURVES[name]
        for each in curve:
            quartiles = (f"{value:.3f}" for value in (each.lower, each.median, each.upper))
            shown_name = title if unit == "1" else f"{title} ({unit})"
            table.add_row(shown_name, str(each.passes), str(each.clusters), *quartiles)
    shown.out.print(table)
    log.print(f"Against {result.reference}. Wrote {out}", highlight=False, markup=False)
