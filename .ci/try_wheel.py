"""Install a wheel as a newcomer does, where there is no compiler, and run the demo with it.

    python .ci/try_wheel.py dist/valuemap-*.whl [--find-links DIR] [--json FILE]

It makes an environment of its own with pip, and a PATH that holds that environment and nothing else; so cargo, rustc
and C compilers are out of reach. Only wheels are installed. With --find-links packages come from that folder and
nowhere else; with --json what came out is written. It runs on every system and every Python that the package supports,
and needs the standard library only.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path
from typing import Any

COMPILERS = ("cargo", "rustc", "cc", "gcc", "g++", "clang", "clang++", "cl", "make", "cmake")
PLATFORMS = {"linux": r"manylinux_\d+_\d+_\w+|manylinux2014_\w+", "darwin": r"macosx_\d+_\d+_\w+", "win32": r"win_\w+"}


def main() -> None:
    """Install and run; end with a status that is not 0 where something does not hold."""
    parser = argparse.ArgumentParser(description="install a wheel without a compiler and run the demo with it")
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--find-links", type=Path, help="folder of wheels; no index is asked then")
    parser.add_argument("--json", type=Path, help="file to write what came out to")
    arguments = parser.parse_args()
    check_name(arguments.wheel.name)
    with tempfile.TemporaryDirectory() as folder:
        programs = make_environment(Path(folder) / "venv")
        environment = {**os.environ, "PATH": str(programs)}
        for name in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"):
            environment.pop(name, None)
        found = [name for name in COMPILERS if shutil.which(name, path=environment["PATH"])]
        expect(not found, f"no compiler on the PATH, found {found}")
        source = ["--no-index", "--find-links", str(arguments.find_links)] if arguments.find_links else []
        install = ["-m", "pip", "install", "--quiet", "--only-binary", ":all:", *source]
        python = str(programs / ("python.exe" if sys.platform == "win32" else "python"))
        begun = time.monotonic()
        run([python, *install, str(arguments.wheel.resolve())], environment, folder)
        installed = time.monotonic()
        seen = try_it(python, str(programs / "valuemap"), environment, Path(folder))
    if arguments.json is not None:
        record = {
            "wheel": arguments.wheel.name,
            "system": describe_system(),
            "compilers on the system": [name for name in COMPILERS if shutil.which(name)],
            "install_s": round(installed - begun),
            **seen,
        }
        arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def check_name(name: str) -> None:
    """Check that any Python from 3.11 on, and any system of the kind that this is, takes the wheel."""
    pattern = rf"valuemap-[^-]+-cp311-abi3-({PLATFORMS[sys.platform]})(\.({PLATFORMS[sys.platform]}))*\.whl"
    expect(re.fullmatch(pattern, name) is not None, f"a wheel named like {pattern}, found {name}")


def make_environment(folder: Path) -> Path:
    """Return the folder of the programs of a new environment."""
    venv.create(folder, with_pip=True)
    return folder / ("Scripts" if sys.platform == "win32" else "bin")


def describe_system() -> str:
    """Return the operating system, its C library and its Python."""
    try:
        name = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        name = platform.platform(terse=True)
    return ", ".join(filter(None, (name, " ".join(platform.libc_ver()).strip(), f"Python {platform.python_version()}")))


def try_it(python: str, command: str, environment: dict[str, str], folder: Path) -> dict[str, Any]:
    """Run what people run first, and return what came out."""
    version = run([command, "--version"], environment, folder).split()[-1]
    expect(run([python, "-m", "valuemap", "--version"], environment, folder).split()[-1] == version, "one version")
    run([python, "-c", "import valuemap; [getattr(valuemap, name) for name in valuemap.__all__]"], environment, folder)
    begun = time.monotonic()
    print(run([command, "demo", "--out", "demo"], environment, folder))
    seconds = round(time.monotonic() - begun)
    evaluation = json.loads(
        run([command, "evaluate", "demo/map", "--truth", "demo/dataset", "--json"], environment, folder)
    )
    expect(evaluation["recall"] > 0.5, f"a map of the demo that finds its lights, found {evaluation['recall']}")
    expect((folder / "demo" / "map.png").stat().st_size > 0, "a picture of the map")
    print(f"valuemap {version} was installed and run without a compiler: recall {evaluation['recall']:.3f}")
    figures = {name: evaluation[name] for name in ("true_positives", "recall", "precision")}
    return {"valuemap": version, "demo_s": seconds, "demo": figures}


def run(command: list[str], environment: dict[str, str], folder: str | Path) -> str:
    """Return what a command prints; its errors are seen, and end the trial."""
    print("+", " ".join(command), flush=True)
    return subprocess.run(command, env=environment, cwd=folder, check=True, stdout=subprocess.PIPE, text=True).stdout


def expect(holds: bool, what: str) -> None:
    """End with one line where something does not hold."""
    if not holds:
        sys.exit(f"error: expected {what}")


if __name__ == "__main__":
    main()
