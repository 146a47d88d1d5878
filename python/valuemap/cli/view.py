"""`valuemap view`."""

from __future__ import annotations

import signal
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.options import MapFolder
from valuemap.cli.show import log, show_notes


@app.command("view")
def view_command(
    map_: MapFolder,
    dataset: Annotated[
        Path | None, typer.Option(help="The dataset of the map; default: found by itself, or not shown.")
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of the pictures; default: images in the dataset.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="A dataset with truth or a file of objects; default: the dataset's own.")
    ] = None,
    basemap: Annotated[
        str | None, typer.Option(metavar="URL|FILE", help="Address of a map style, or a .pmtiles file.")
    ] = None,
    review: Annotated[Path | None, typer.Option(help="File of the decisions; default: review.json in the map.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0 for a free one.")] = 0,
    no_open: Annotated[bool, typer.Option("--no-open", help="Print the address and open no browser.")] = False,
) -> None:
    """Look at a map in the browser: what each label rests on, why a place is empty; accept and reject labels."""
    from valuemap.viewer.scene import Scene
    from valuemap.viewer.server import Basemap, Content, ViewServer

    below = None if basemap is None else Basemap.from_text(basemap)

    def read_scene() -> Scene:
        return Scene(map_, dataset_folder=dataset, pictures=images, truth=truth)

    content = Content(read_scene, review)
    server = ViewServer(content, port=port, basemap=below)
    show_notes(content.scene.notes)
    print(server.address, flush=True)
    log.print("Decisions are saved as you make them. Ctrl-C ends.", highlight=False)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # Ends as quietly as Ctrl-C.
    if not no_open:
        webbrowser.open(server.address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        server.server_close()
