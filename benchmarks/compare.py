"""Compares the benchmarks of two checkouts: ``compare.py BEFORE [AFTER] [--only NAME ...]``.

BEFORE and AFTER are checkouts, each with its own ``.venv`` (``make .venv/packages``); AFTER
defaults to this one. Each benchmark runs alternately in BEFORE and in AFTER, ``--rounds`` times
each, so a machine whose speed drifts affects both equally. Printed are the medians of every ratio
to a baseline and of every claim that both print (the inverse of a claim "at most"), and the change.
Claim: the geometric mean of the changes is at least 0.95 in each benchmark.
"""

from __future__ import annotations

import argparse
import re
import statistics
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

from measure import claim, finish

HERE = Path(__file__).resolve().parents[1]
NAMES = (
    "generation", "training", "prediction", "transport", "dataset", "backends", "differentiable",
    "gym", "idle_threads", "remote",
)  # fmt: skip
RATE = re.compile(r"^  (\S.*?)\s+[\d,]+ \S+/s  \[.*\]  ratio (\S+)$")
CLAIM = re.compile(r"^  (.+): (\S+), target at (least|most) ")
Figures = dict[str, float]


def figures_of(checkout: Path, name: str) -> Figures:
    """Run a benchmark and return the ratios and claims that it prints; larger is better."""
    command = [checkout / ".venv/bin/python", f"benchmarks/{name}.py"]
    done = subprocess.run(
        list(map(str, command)), cwd=checkout, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{checkout}: {name} failed:\n{done.stderr}")
    found: Figures = {}
    heading = ""
    for line in done.stdout.splitlines():
        if (rate := RATE.match(line)) and rate[2] != "1.00":  # 1.00 is the baseline itself
            found[f"{heading}: {rate[1]}"] = float(rate[2])
        elif stated := CLAIM.match(line):
            value = float(stated[2])
            found[f"{heading}: {stated[1]}"] = value if stated[3] == "least" else 1 / value
        elif line and not line.startswith(" "):
            heading = line.rstrip(":")
    return found


def compare(before: Path, after: Path, name: str, rounds: int) -> float:
    """Print the figures of one benchmark in both checkouts; return their mean ratio."""
    measured: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for _ in range(rounds):
        for place, checkout in enumerate((before, after)):
            for key, value in figures_of(checkout, name).items():
                measured[key][place].append(value)
    ratios = []
    print(f"{name}: before, after, after / before")
    for key, (old, new) in measured.items():
        if old and new:
            first, second = statistics.median(old), statistics.median(new)
            ratios.append(second / first)
            print(f"  {first:10.4g} {second:10.4g} {ratios[-1]:6.2f}  {key}")
    return statistics.geometric_mean(ratios)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path, nargs="?", default=HERE)
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--check", action="store_true", help="exit with 1 if a target is missed")
    options = parser.parse_args()
    means = {
        name: compare(options.before.resolve(), options.after.resolve(), name, options.rounds)
        for name in options.only
    }
    finish([claim(name, mean, at_least=0.95) for name, mean in means.items()])


if __name__ == "__main__":
    main()
