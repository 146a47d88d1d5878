"""`valuemap check`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from valuemap import dataset as dataset_folder
from valuemap.cli.app import app
from valuemap.cli.options import AsJson, Force
from valuemap.cli.show import log, progress_bars, show
from valuemap.dataset import check_dataset, read_dataset, write_dataset
from valuemap.folders import check_place, keep_input
from valuemap.tiles.part import is_large, read_part

_WRONG = 3
"""Exit code where something is wrong: scripts can tell it from a command that failed (1) and from bad use (2)."""


@app.command("check")
def check_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that an import or simulate command wrote.")],
    fix: Annotated[
        Path | None,
        typer.Option("--fix", metavar="OUT", help="Write the dataset with what can be put right put right."),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with a dataset, how sure that is, and what the data can give."""
    from valuemap.check import examine, far_images

    if fix is not None:
        keep_input(fix, dataset, "--fix")
        check_place(fix, parts=dataset_folder.PARTS, force=force)
    # What is put right is so in all rows.
    part = read_part(dataset, also=far_images, are_boxes_checked=False) if fix is None and is_large(dataset) else None
    given = read_dataset(dataset, are_boxes_checked=False) if part is None else part.dataset
    with progress_bars() as progress:
        outcome = examine(given, drives=None if part is None else part.drives, progress=progress)
    told = outcome.to_json()
    if part is not None:
        told |= {"looked_at": part.to_json(), "prospects": {**told["prospects"], **part.counts}}
    if as_json:
        print(json.dumps({"dataset": given.name, **told}, indent=2))
    else:
        _tell(told)
        if part is not None:
            print(f"\nnote: {part.note}")
    if fix is not None:
        check_dataset(outcome.fixed, source=str(fix))  # What is wrong then is wrong with what is written.
        write_dataset(outcome.fixed, fix, force=force)
        fixed = sum(finding.fix is not None for finding in outcome.findings)
        log.print(f"Put right {fixed} of {len(outcome.findings)} and wrote {fix}", highlight=False, markup=False)
    if outcome.findings:
        raise typer.Exit(_WRONG)


def _tell(outcome: dict[str, Any]) -> None:
    """Print findings as paragraphs, and what the data can give as a table."""
    findings = outcome["findings"]
    if findings:
        print(f"{len(findings)} {'thing is' if len(findings) == 1 else 'things are'} wrong.\n")
    else:
        certain = "Nothing is wrong as far as can be seen."
        print("Nothing can be proved to be wrong.\n" if outcome["notes"] else f"{certain}\n")
    for number, finding in enumerate(findings, 1):
        print(f"{number}. {finding['what']} ({finding['sure']}; {finding['fault']})")
        print(f"   Why: {finding['why']}")
        print(f"   What to do: {finding['do']}")
        if finding["has_fix"]:
            print("   --fix does it.")
        print()
    for note in outcome["notes"]:
        print(f"note: {note}\n")
    facts = {name.replace("_", " "): _shown(value) for name, value in outcome["prospects"].items()}
    is_mended = any(finding["has_fix"] for finding in findings)
    show(facts, title="What the data can give" + (", once put right" if is_mended else ""))


def _shown(value: Any) -> Any:
    """Return a spread as one text."""
    return f"{value['median']} ({value['p10']} to {value['p90']})" if isinstance(value, dict) else value
