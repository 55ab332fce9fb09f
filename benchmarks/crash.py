"""Power cuts: opens every legal state of the disk and checks that nothing wrong is ever read back.

Random histories of calls are generated, and everything that they do to the disk is recorded. The
states that a cut may leave at each moment (defined in `tests/core/crash/powercut/disk.py`) are
built in memory, opened as after a reboot, and compared with what had been promised at that moment.
Some are also verified, opened for writing, repaired and rebuilt.

    python benchmarks/crash.py                # one minute; ends with status 1 if something is wrong
    python benchmarks/crash.py --check        # 15 minutes; ends with status 1 if a target is missed
    python benchmarks/crash.py --check --small
    python benchmarks/crash.py --seconds 3000 --first 5000 --processes 1
    python benchmarks/crash.py --replay 36/0/110/5    # as printed with a problem: a state or seed
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import count, repeat
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "core" / "crash"))

from measure import claim
from powercut.checker import Problem, Result, campaign, replay

PROCESSES = 2
SHOWN = 20
FULL = {"seconds": 900.0, "states": 500_000}
SMALL = {"seconds": 55.0, "states": 10_000}


def folder() -> Path:
    """Return a new folder, in memory if possible."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None))


def work(first: int, step: int, seconds: float) -> Result:
    """Examine every `step`-th history, starting at `first`."""
    root = folder()
    try:
        return campaign(count(first, step), root, seconds)
    finally:
        shutil.rmtree(root)


def examine(first: int, processes: int, seconds: float) -> Result:
    """Examine histories in several processes."""
    total = Result()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context) as pool:  # tells that one of them has ended
        firsts = range(first, first + processes)
        for result in pool.map(work, firsts, repeat(processes), repeat(seconds)):
            total.add(result)
    return total


def show(problems: list[Problem]) -> None:
    """Print problems, and how to replay them."""
    for problem in problems[:SHOWN]:
        print(f"{problem}\n    replay: python benchmarks/crash.py --replay {problem.place}")
    if len(problems) > SHOWN:
        print(f"... and {len(problems) - SHOWN} more")


def run_replay(place: str) -> None:
    """Examine one history again, and print everything about one of its states."""
    root = folder()
    try:
        problems = replay(place, root)
    finally:
        shutil.rmtree(root)
    show(problems)
    sys.exit(1 if problems else 0)


def main() -> None:
    """Examine states and print what was found."""
    parser = argparse.ArgumentParser(description="Examine what power cuts may leave.")
    parser.add_argument("--check", action="store_true", help="end with status 1 on a miss")
    parser.add_argument("--small", action="store_true", help="a minute instead of 15")
    parser.add_argument("--seconds", type=float, help="how long")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--processes", type=int, default=PROCESSES, help="how many at once")
    parser.add_argument("--replay", metavar="PLACE", help="seed, or place of a problem")
    given = parser.parse_args()
    if given.replay:
        run_replay(given.replay)
    size = FULL if given.check and not given.small else SMALL
    began = time.monotonic()
    found = examine(given.first, given.processes, given.seconds or size["seconds"])
    seconds = time.monotonic() - began
    rate = found.distinct / seconds
    print(f"{found.histories} histories in {seconds:.0f} s on {os.cpu_count()} cores")
    print(
        f"{found.distinct} different states, {rate:.0f} each second, {found.examined} comparisons"
    )
    print(f"done with some of them: {dict(found.deep)}")
    show(found.problems)
    met = claim("violations", len(found.problems), at_most=0)
    met &= claim("different states", found.distinct, at_least=2 * size["states"])
    met &= claim("of those with free axes", found.free, at_least=size["states"])
    sys.exit(1 if found.problems or (given.check and not met) else 0)


if __name__ == "__main__":
    if os.environ.get("PYTHONHASHSEED") != "0":  # a replay needs the same iteration order of sets
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"PYTHONHASHSEED": "0"})
    main()
