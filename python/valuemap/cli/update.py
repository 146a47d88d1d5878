"""`valuemap update`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from valuemap import map_folder
from valuemap.cli.app import app
from valuemap.cli.options import AsJson, EngineName, Force, RayAddress, Resume, Threads, TileSize, Work
from valuemap.cli.show import log, progress_bars, show, show_notes
from valuemap.cli.working import working
from valuemap.engine.choose import engine_named
from valuemap.evidence import find_dataset
from valuemap.folders import check_place, keep_input
from valuemap.map_folder import read_record, write_map
from valuemap.pipeline import Run
from valuemap.summary import summarize_map
from valuemap.update import update_map


@app.command("update", epilog="What the states mean: docs/update.md.")
def update_command(
    old: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of the map to bring up to date.")],
    added: Annotated[Path, typer.Option("--add", metavar="DATASET", help="Dataset with the new passes.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write the new map to.")],
    dataset: Annotated[
        Path | None, typer.Option(help="Dataset of the map. Default: where the map says that it is.")
    ] = None,
    threads: Threads = 0,
    tile_size: TileSize = None,
    engine: EngineName = "threads",
    ray_address: RayAddress = None,
    work: Work = None,
    resume: Resume = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Add new passes to a map: only what they touch is solved again, ids stay, and changes are told."""
    # What an older map has there gives way; the same map may be written anew, with its own dataset and more.
    of_old = None if out.resolve() == old.resolve() else find_dataset(old, read_record(old), dataset)
    for read in (added, *([of_old] if of_old else ())):
        for folder in map_folder.PART_FOLDERS:
            keep_input(out / folder, read, "--out")
    check_place(out, parts=map_folder.PARTS, force=force)
    with working(work, out, resume=resume) as place, progress_bars() as progress:
        where = engine_named(engine, threads=threads, ray_address=ray_address)
        run = Run(place.folder, where, tile_size_m=tile_size, store=place.store)
        result, cells, files = update_map(old, added, run, dataset=dataset, progress=progress)
        result.run["dataset_folder"] = map_folder.DATASET
        write_map(result, out, cells=cells, files=files, force=force)
    show_notes(result.run["notes"])
    if as_json:
        print(json.dumps(result.run, indent=2))
    else:
        show(summarize_map(result))
        log.print(f"Wrote {out}", highlight=False)
