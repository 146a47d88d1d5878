"""What commands print for people: facts in two columns on stdout, notes and progress on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as ProgressBars
from rich.table import Table
from rich.text import Text

from valuemap.progress import Progress

if TYPE_CHECKING:
    from valuemap.evaluate import Evaluation

SHOWN_PROBLEMS = 5
"""How many problems of one kind are printed before the rest is counted."""

_TOLD_AS = {
    "extent_m": "extent in m",
    "images_by_detections": "images with 0, 1, 2, ... detections",
    "median_reprojection_rms_px": "median reprojection rms in px",
}

# Names of users are no markup: a class may be called [/].
out = Console(markup=False, emoji=False)
log = Console(stderr=True, markup=False, emoji=False, soft_wrap=True)


def show(facts: Mapping[str, Any], *, title: str | None = None) -> None:
    """Print facts as two columns on stdout, in words: `images_on_rigs` is told as "images on rigs"."""
    table = Table(show_header=False, box=None, title=title, title_justify="left", title_style="bold")
    table.add_column(no_wrap=True)
    table.add_column(justify="right")
    for name, value in facts.items():
        table.add_row(_TOLD_AS.get(name, name.replace("_", " ")), worded(name, value))
    out.print(table)


def worded(name: str, value: Any) -> str:
    """Return the value of a fact as a person reads it."""
    if name == "frame":
        return _frame(value)
    if name == "extent_m":
        return " x ".join(f"{side:.0f}" for side in value)
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_short(each)}" for key, each in value.items()) or "-"
    if isinstance(value, list | tuple):
        return (" " if all(isinstance(each, int) for each in value) else ", ").join(map(_short, value)) or "-"
    return "-" if value is None else str(value)


def _short(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " ".join(map(_short, value)) or "-"
    if value is None:
        return "unknown"
    return f"{value:.2g}" if isinstance(value, float) else str(value)


def _frame(frame: Mapping[str, Any]) -> str:
    if "anchor" not in frame:
        return f"local, up {' '.join(f'{c:.3g}' for c in frame['up'])}"
    anchor = frame["anchor"]
    return f"east, north, up at lat {anchor['lat']:.7f} lon {anchor['lon']:.7f} height {anchor['height']:.2f} m"


def show_notes(notes: Iterable[str]) -> None:
    """Print each note as one line on stderr."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def evaluation_rows(evaluation: Evaluation) -> dict[str, Any]:
    """Return the measures with what they are measured against, for people."""
    return {
        "labels": evaluation.labels,
        "true objects": evaluation.objects,
        "recoverable objects": evaluation.recoverable_objects,
        **evaluation.measures(),
    }


class _SpeedColumn(ProgressColumn):
    """How much gets done a second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Yield a callback that draws one bar for each kind of work on stderr, if that is a terminal."""
    columns = (
        SpinnerColumn(),  # Some steps are long, and cannot say how far they are.
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _SpeedColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with ProgressBars(*columns, console=log, transient=True, disable=not log.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def progress(what: str, done: int, total: int) -> None:
            if what not in tasks:
                for earlier in bars.tasks:  # What comes next begins when what was before has ended.
                    bars.update(earlier.id, completed=earlier.total)
                tasks[what] = bars.add_task(what, total=total)
            elif done == 0 and bars.tasks[tasks[what]].finished:  # The same work once more, on something else.
                bars.reset(tasks[what], total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield progress
