"""The application that every command adds itself to, and how its errors come out."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Annotated, Any

import typer
import typer.core

from valuemap.cli.load import COMMANDS, name_of
from valuemap.cli.signals import Terminated, end_in_order, exit_code
from valuemap.errors import ValuemapError

_WrongUse: Any = typer.BadParameter.__bases__[0]
"""Options and arguments that cannot be; Typer gives the class no name of its own."""

_NOTHING_WRITTEN = ("nothing was written", "run the same command again to start over")


@contextmanager
def _wrong_use_in_one_line() -> Iterator[None]:
    """Say in one line which option or argument cannot be, as with all other errors, and exit with 2."""
    try:
        yield
    except _WrongUse as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # Its message is the help.
            raise
        message = " ".join(error.format_message().replace("Value error, ", "").split())
        command = "valuemap" if error.ctx is None else error.ctx.command_path
        complain(f"error: {message}", f"{command} --help says what it takes")
        sys.exit(error.exit_code)


class _Commands(typer.core.TyperGroup):
    """Commands in the order of use, whose errors come out as one line and a hint, and a status that is not 0."""

    def list_commands(self, ctx: Any) -> list[str]:
        order = {name_of(module): place for place, module in enumerate(COMMANDS)}
        return sorted(super().list_commands(ctx), key=order.__getitem__)

    def make_context(self, info_name: str | None, args: list[str], *arguments: Any, **named: Any) -> Any:
        # An empty path would be the folder that one is in: what `--out "$UNSET"` says, and does not mean.
        if any(not arg or (arg.startswith("--") and arg.endswith("=") and arg.count("=") == 1) for arg in args):
            complain("error: an argument is empty", "is a variable of the shell not set? Leave out what is not wanted")
            sys.exit(2)
        with _wrong_use_in_one_line():
            return super().make_context(info_name, args, *arguments, **named)

    def invoke(self, ctx: Any) -> Any:
        with on_interrupt(*_NOTHING_WRITTEN), _wrong_use_in_one_line():
            end_in_order()  # Not before: nobody would catch what it raises while the commands are built.
            try:
                return super().invoke(ctx)
            except ValuemapError as error:
                complain(f"error: {error}", error.hint)
                sys.exit(1)


def complain(message: str, hint: str) -> None:
    """Print one line and a hint on stderr."""
    print(message, file=sys.stderr)
    print(f"hint: {hint}", file=sys.stderr)


@contextmanager
def on_interrupt(state: str, hint: str) -> Iterator[None]:
    """Say in one line what is on disk when the user, or a signal to end, stops the work, and exit as shells expect."""
    try:
        yield
    except KeyboardInterrupt:
        complain(f"interrupted: {state}", hint)
        sys.exit(exit_code(signal.SIGINT))
    except Terminated as end:
        complain(f"terminated: {state}", hint)
        sys.exit(exit_code(end.signal))


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> None:
    if asked:
        print(f"valuemap {version('valuemap')}")
        raise typer.Exit


@app.callback()
def options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Many posed street images in, a 3D map of static objects out, with nobody labelling anything."""
