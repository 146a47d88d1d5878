"""The process that does the work: started, listened to, and ended, whatever happens to either side."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.readers.cameras_of import Camera
from valuemap.readers.structure.job import LOG, Job, Picture, Posed, prepare, read_answer

CHILD = "valuemap.readers.structure.child"


def find_poses(
    pictures: Sequence[Picture],
    cameras: Sequence[Camera],
    has_focal: Sequence[bool],
    workspace: Path,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> Posed:
    """Find the poses of pictures in driving order; those that cannot be found are named with their reason.

    The work is done by a process of its own, because pycolmap cannot be interrupted, and may take the process down with
    it, also when that ends. What was found stays in the workspace, so that an interrupted run goes on.

    Parameters
    ----------
    pictures
        In driving order within each drive.
    cameras, has_focal
        First guesses of the intrinsics (K), which are refined, and whether their focal lengths are known.
    workspace
        Folder that is made for what is found on the way; one that was made for other pictures is begun anew.
    threads
        0 for one a core.

    Raises
    ------
    InputError
        The folder is somebody else's, or no model can be made or placed.
    OutputError
        The folder cannot be written to.
    """
    prepare(workspace, Job(pictures, cameras, has_focal))
    posed = read_answer(workspace)
    if posed is None:
        _work(workspace, threads, progress)
        posed = read_answer(workspace)
    if posed is None:
        raise InputError(
            f"{workspace}: structure from motion ended without an answer; see {LOG} there",
            hint="run the same command again: it goes on from where it was",
        )
    return posed


def _work(workspace: Path, threads: int, progress: Progress) -> None:
    """Let the process work; raise what it could not do as an `InputError`."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with (
        (workspace / LOG).open("wb") as log,
        subprocess.Popen(
            [sys.executable, "-m", CHILD, str(workspace), str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env=environment,
            start_new_session=True,  # Ctrl-C is for us: we end it.
        ) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                kind, *said = json.loads(line)
                if kind == "error":
                    message, hint = said
                    raise InputError(message, hint=hint)
                progress(*said)
            code = process.wait()
        finally:
            process.kill()
    if code < 0:
        name = signal.Signals(-code).name
        what = "was killed: is there enough memory?" if -code == signal.SIGKILL else f"crashed ({name})"
        raise InputError(
            f"{workspace}: structure from motion {what}",
            hint="run the same command again: it goes on from where it was",
        )
    if code > 0:
        raise InputError(
            f"{workspace}: structure from motion failed: {_last_line(workspace / LOG)}",
            hint=f"see {workspace / LOG}, and report it with that file",
        )


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((" ".join(line.split())[:300] for line in reversed(lines) if line.strip()), "it said nothing")
