"""`valuemap train`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app, on_interrupt
from valuemap.cli.options import AsJson, Settings
from valuemap.cli.show import SHOWN_PROBLEMS, progress_bars, show
from valuemap.config import TrainConfig


@app.command("train")
def train_command(
    data: Annotated[
        list[str], typer.Option(help="Labelled pictures: bosch:FILE, yolo:DIR or coco:FILE; may be repeated.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for checkpoints, metrics and the model.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last epoch of an interrupted run.")] = False,
    one_class: Annotated[str | None, typer.Option("--class", help="Take every label as this one class.")] = None,
    seed: Annotated[int, typer.Option(help="Of the first weights, the split and all variation.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="Threads of the network, 0 as PyTorch chooses.")] = 0,
    assignments: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train a network on labelled pictures; needs the extra named train."""
    from valuemap.detect.labels import read_labels
    from valuemap.detect.train import train

    config = TrainConfig().with_settings(assignments or [])
    state, hint = "all finished epochs are kept", "go on with the same command and --resume"
    with on_interrupt(state, hint), progress_bars() as progress:
        labels = [read_labels(source) for source in data]
        result = train(
            labels,
            out,
            config,
            resume=resume,
            one_class=one_class,
            seed=seed,
            threads=threads,
            progress=progress,
        )
    facts = {**asdict(result), "model": str(result.model)}
    skipped, counts = facts.pop("skipped"), facts.pop("counts")
    if as_json:
        print(json.dumps({**facts, "counts": counts, "skipped": skipped}, indent=2))
        return
    show({**{name.replace("_", " "): value for name, value in counts.items()}, **facts})
    for line in skipped[:SHOWN_PROBLEMS]:
        print(f"note: {line}", file=sys.stderr)
    if len(skipped) > SHOWN_PROBLEMS:
        print(f"note: {len(skipped)} pictures or labels were left out", file=sys.stderr)
