"""The command line: the only place that parses arguments, prints and exits. One file a command."""

from __future__ import annotations

from valuemap.cli.signals import end_at_once


def main() -> None:
    """Run the command line."""
    end_at_once()
    import gc
    import os
    import sys

    # Work is shared out to threads of our own: those of BLAS wait in a loop, a twentieth of the time of an update.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Arrow then takes memory that arrays gave back: that of a pool of its own is zeroed first, 0.2 s of an update.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # They are looked for in all packages there are.
    gc.disable()  # What is imported stays: looking for garbage among it takes a fifth of the time.
    from valuemap.cli.app import app, complain
    from valuemap.cli.load import load_commands
    from valuemap.cli.output import end_output, watch_output

    load_commands(sys.argv[1:])
    watch_output()
    gc.freeze()  # Nor is it looked through later, or at the end, which takes 0.1 s.
    gc.enable()
    try:
        app(prog_name="valuemap")  # That of `python -m valuemap` too, which completion in a shell knows nothing of.
    finally:
        error = end_output()
        if error is not None:
            complain(f"error: not all that this command prints could be written: {error.strerror}", "is the disk full?")
            sys.exit(1)
