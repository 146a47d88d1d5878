"""What commands print for people: facts in two columns on stdout, notes and progress on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBars
from rich.table import Table
from rich.text import Text

from valuemap.evaluate import Evaluation
from valuemap.progress import Progress

SHOWN_PROBLEMS = 5
"""How many problems of one kind are printed before the rest is counted."""

# Names of users are no markup: a class may be called [/].
out = Console(markup=False, emoji=False)
log = Console(stderr=True, markup=False, emoji=False)


def show(facts: dict[str, Any], *, title: str | None = None, console: Console = out) -> None:
    """Print facts as two columns; nested ones as name.key."""
    table = Table(show_header=False, box=None, title=title, title_justify="left", title_style="bold")
    table.add_column(no_wrap=True)
    table.add_column(justify="right")
    for name, value in facts.items():
        table.add_row(name, f"{value:.3f}" if isinstance(value, float) else str(value))
    console.print(table)


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
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _SpeedColumn(),
        TimeRemainingColumn(),
    )
    with ProgressBars(*columns, console=log, transient=True, disable=not log.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def progress(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what)
            bars.update(tasks[what], completed=done, total=total)

        yield progress
