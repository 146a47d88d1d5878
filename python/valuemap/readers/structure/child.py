"""`python -m valuemap.readers.structure.child WORKSPACE THREADS`: the work itself, one line of JSON a step on stdout.

It ends when its stdin does: whoever started it has ended. It leaves without the end of a process that destructors of
libraries may crash.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

from valuemap.errors import ValuemapError


def main() -> None:
    """Work in the folder that the arguments name, and leave at once."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as out:
        os.dup2(2, 1)  # What libraries print goes into the log.

        def say(*what: Any) -> None:
            out.write(json.dumps(what) + "\n")
            out.flush()

        code = 0
        try:
            work(Path(sys.argv[1]), int(sys.argv[2]), lambda what, done, total: say("progress", what, done, total))
        except ValuemapError as error:
            say("error", str(error), error.hint)
        except BaseException:  # Whatever it is, its last line is what the user gets.
            traceback.print_exc()
            code = 1
        sys.stderr.flush()
    os._exit(code)


def work(workspace: Path, threads: int, progress: Any) -> None:
    """Find poses, and keep them in the folder."""
    from valuemap.colmap import pycolmap
    from valuemap.readers.structure.features import find_features
    from valuemap.readers.structure.job import read_job, write_answer
    from valuemap.readers.structure.mapping import find_models
    from valuemap.readers.structure.pairs import match_pairs

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # It tells every step.
    job = read_job(workspace)
    find_features(job, workspace, threads=threads or -1, progress=progress)
    match_pairs(job, workspace, threads=threads or -1, progress=progress)
    write_answer(workspace, find_models(job, workspace, threads=threads or -1, progress=progress))


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


if __name__ == "__main__":
    main()
