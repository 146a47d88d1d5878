"""Fuzz the readers, the tables, the settings and the border of the core with structured input.

    python benchmarks/fuzz.py [--cases N] [--core-cases N] [--seconds S] [--seed N] [--only TARGET ...] [--json FILE]
                              [--go-on]

Every case makes whole input, spoils a value, a row, a column, a key, bytes or an array of it, and reads or maps it. It
must end in a result, or in an error of one line with a hint: any other exception, a panic of the core, and a case of
more than 20 seconds of the processor are faults. Case k of a target has the seed "SEED/TARGET/k", so that one case can
be run again:

    python benchmarks/fuzz.py --only TARGET --case K

The JSON file is written as the run goes, and with `--go-on` an interrupted run goes on from it.

With `--core-cases` so many cases of `crates/valuemap-core/src/tests/hostile_input.rs` go through the core without
Python before, built with its assertions and with overflows as faults: needs cargo.

The targets are those of `tests/test_fuzz.py` (see `tests/fuzzing.py`), where hypothesis draws the cases.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzing import Fuzz, Target
from machine import describe_machine, keep_record

LONGEST_S, LONGEST_ASLEEP_S = 20, 600
"""Of the processor, and by the clock: of a busy machine a case may get little."""
MOST_MEMORY = 6 * 2**30
"""Of addresses: what asks for more fails at once instead of filling the machine."""
MOST_SHOWN = 3
KEPT_EVERY_S = 60.0
SHARES = {"border of the core": 8.0}
"""All targets get the same time, but this one, behind which there is no Python to catch what goes wrong."""


CORE_TESTS = {
    "partitions_of_hostile_positions": 20,
    "votes_of_hostile_rays": 25,
    "evidence_of_hostile_points": 20,
    "labels_of_hostile_scenes": 18,
    "noise_of_hostile_scenes": 3,
    "misfits_of_hostile_scenes": 2,
    "objects_of_hostile_scenes": 12,
}
"""Tests of the core with shares of its cases: those that estimate noise search each case some fifteen times."""
STRICT = ("lto=false", "codegen-units=16", "debug-assertions=true", "overflow-checks=true")


class Hang(BaseException):
    """A case takes too long."""


def _alarm(_number: int, _frame: FrameType | None) -> None:
    raise Hang


def run_case(target: Target, seed: str) -> BaseException | None:
    """Run one case; return what it must not raise."""
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    signal.alarm(LONGEST_ASLEEP_S)
    try:
        target.run(Random(seed))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # A panic of the core is no Exception.
        return error
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return None


def place_of(error: BaseException) -> str:
    """Return what went wrong where: faults that have this in common are one."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if "valuemap" in f.filename or "fuzzing" in f.filename
    ]
    at = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    said = str(error).splitlines()[0][:120] if str(error) else ""
    return f"{type(error).__name__} at {at}: {said}"


def run_core(cases: int, seed: int) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, Any]]]:
    """Run the tests of the core, `cases` all together; return cases and seconds of each, and faults."""
    command = ["cargo", "test", "--quiet", "--locked", "--package", "valuemap-core", "--lib"]
    command += ["--release", *(part for each in STRICT for part in ("--config", f"profile.release.{each}"))]
    repository = Path(__file__).parents[1]
    subprocess.run([*command, "--no-run"], cwd=repository, check=True)
    done: dict[str, dict[str, float]] = {}
    faults: dict[str, dict[str, Any]] = {}
    for name, share in CORE_TESTS.items():
        own = cases * share // sum(CORE_TESTS.values())
        environment = os.environ | {
            "VALUEMAP_FUZZ_CASES": str(own),
            "VALUEMAP_FUZZ_SEED": str(seed + 1),
            "RUST_BACKTRACE": "0",
        }
        start = time.perf_counter()
        outcome = subprocess.run(
            [*command, "--", "--exact", f"tests::hostile_input::{name}"],
            cwd=repository, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        done[name] = {"cases": own, "seconds": round(time.perf_counter() - start, 1)}
        print(f"core: {name:34} {own:8} cases {done[name]['seconds']:8.1f} s", flush=True)
        if outcome.returncode:
            said = [line for line in outcome.stdout.splitlines() if "Test failed" in line] or ["stopped"]
            faults[f"core: {name}: {said[0][:200]}"] = {"count": 1, "cases": []}
            print(f"FAULT core: {name}: {said[0][:200]}", flush=True)
    return done, faults


def record_of(
    options: argparse.Namespace,
    done: Counter[str],
    seconds: dict[str, float],
    of_core: dict[str, dict[str, float]],
    faults: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """Return what is kept: how it was run, how many cases of what, and all faults."""
    return {
        "benchmark": "fuzz",
        "command": f"python benchmarks/fuzz.py --cases {done.total()} --core-cases {options.core_cases} "
        f"--seed {options.seed}",
        **describe_machine(),
        "cases": done.total(),
        "seconds": round(sum(seconds.values()), 1),
        "cases_by_target": dict(sorted(done.items())),
        "seconds_by_target": {name: round(seconds[name], 1) for name in sorted(done)},
        "core_cases": sum(int(each["cases"]) for each in of_core.values()),
        "core_by_test": of_core,
        "faults": faults,
    }


def main() -> int:
    """Run the benchmark; return the exit code: 1 where there are faults."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--core-cases", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--case", type=int, help="one case, with its traceback")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--go-on", action="store_true", help="go on from what the JSON file has")
    options = parser.parse_args()
    before_that = json.loads(options.json.read_text(encoding="utf-8")) if options.go_on else {}
    of_core, faults_of_core = before_that.get("core_by_test", {}), before_that.get("faults", {})
    if options.core_cases and not of_core:
        of_core, faults_of_core = run_core(options.core_cases, options.seed)
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    signal.signal(signal.SIGALRM, _alarm)
    signal.signal(signal.SIGPROF, _alarm)
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        targets = [t for t in Fuzz(Path(folder)).targets if not options.only or t.name in options.only]
        if options.case is not None:
            error = run_case(targets[0], f"{options.seed}/{targets[0].name}/{options.case}")
            if error is not None:
                traceback.print_exception(error)
            return int(error is not None)
        start = kept_s = time.perf_counter()
        last = Path(folder) / "last-case"  # In memory: on a disk this takes longer than many a case.
        done = Counter(before_that.get("cases_by_target", {}))
        seconds = {target.name: before_that.get("seconds_by_target", {}).get(target.name, 0.0) for target in targets}
        faults: dict[str, dict[str, Any]] = faults_of_core
        while done.total() < options.cases and time.perf_counter() - start < options.seconds:
            target = min(targets, key=lambda each: seconds[each.name] / SHARES.get(each.name, 1.0))
            before = time.perf_counter()
            for _ in range(min(20, options.cases - done.total())):
                number = done[target.name]
                done[target.name] += 1
                last.write_text(f"{target.name}, case {number}")  # For what ends the whole process.
                error = run_case(target, f"{options.seed}/{target.name}/{number}")
                if error is None:
                    continue
                key = f"{target.name}: {place_of(error)}"
                known = faults.setdefault(key, {"count": 0, "cases": []})
                known["count"] += 1
                if len(known["cases"]) < MOST_SHOWN:
                    known["cases"].append(number)
                if known["count"] == 1:
                    print(f"FAULT {key} (case {number})", flush=True)
            seconds[target.name] += time.perf_counter() - before
            if time.perf_counter() - kept_s > KEPT_EVERY_S:
                kept_s = time.perf_counter()
                keep_record(options.json, record_of(options, done, seconds, of_core, faults))
    for name, count in sorted(done.items()):
        print(f"{name:24} {count:8} cases {1e3 * seconds[name] / count:7.2f} ms each")
    print(f"{done.total()} cases in {sum(seconds.values()):.0f} s, {len(faults)} faults")
    keep_record(options.json, record_of(options, done, seconds, of_core, faults))
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
