"""`valuemap simulate`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from valuemap.cli.app import app, on_interrupt
from valuemap.cli.import_.app import check_out, finish_dataset, finish_dataset_of_pieces
from valuemap.cli.options import AsJson, DatasetOut, Force, Settings
from valuemap.cli.show import log, progress_bars
from valuemap.dataset import write_dataset_in_pieces

Preset = Literal["small", "sf", "nyc", "10x-nyc"]


@app.command("simulate")
def simulate_command(
    out: DatasetOut,
    preset: Annotated[Preset, typer.Option(help="sf and nyc have the sizes of the paper's two data sets.")] = "small",
    seed: Annotated[int, typer.Option(help="Another seed, another city.")] = 0,
    images: Annotated[
        bool, typer.Option("--images", help="Draw the pictures too, with the true boxes in boxes.json.")
    ] = False,
    assignments: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a city, drives through it and a noisy detector, with truth."""
    from valuemap.simulate import PRESETS, record_city, simulate_districts

    check_out(out, force=force)
    config = PRESETS[preset].with_settings(assignments or [])
    if images:
        config.check_drawable()
    if config.districts > 1:
        with progress_bars() as progress:
            write_dataset_in_pieces(
                simulate_districts(config, seed=seed, name=out.resolve().name, progress=progress), out, force=force
            )
        finish_dataset_of_pieces(out, as_json=as_json)
        return
    with progress_bars() as progress:
        recording = record_city(config, seed=seed, name=preset, progress=progress)
    finish_dataset(recording.dataset, out, force=force, as_json=as_json)
    if images:
        from valuemap.simulate.render import render_images  # Draws with a library that nothing else here needs.

        state, hint = "the dataset is whole, its pictures are not", "run the same command again"
        with on_interrupt(state, hint), progress_bars() as progress:
            painted = render_images(recording, out, progress=progress)
        log.print(f"Drew {painted} pictures in {out / 'images'}", highlight=False)
