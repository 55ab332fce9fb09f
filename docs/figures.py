"""Runs benchmarks, keeps what they print in docs/figures/, and shows it in docs/figures.md.

python docs/figures.py NAME ...    # runs benchmarks/NAME.py: minutes, on a quiet machine
python docs/figures.py             # writes the page from what is kept
"""

from __future__ import annotations

import argparse
import ast
import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
BENCHMARKS = HERE.parent / "benchmarks"
PAGE, KEPT = HERE / "figures.md", HERE / "figures"
MARK = "<!-- What follows is written by figures.py. -->"
# Those that others start:
OTHERS = {"compare", "jiminy_zoo", "many_clients", "remote_servers", "transport_costs"}


def names() -> list[str]:
    """Return the names of all benchmarks."""
    found = {
        path.stem
        for path in BENCHMARKS.glob("*.py")
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    }
    return sorted(found - OTHERS)


def run(name: str) -> int:
    """Run a benchmark, keep what it prints, and return its exit status."""
    words = [sys.executable, str(BENCHMARKS / f"{name}.py")]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    head = (
        f"{datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}, exit status {done.returncode}"
    )
    KEPT.mkdir(exist_ok=True)
    (KEPT / f"{name}.txt").write_text(f"{head}\n\n{done.stdout}", encoding="utf-8")
    return done.returncode


def section(name: str) -> str:
    """Return what the page says of a benchmark."""
    source = (BENCHMARKS / f"{name}.py").read_text(encoding="utf-8")
    told = ast.get_docstring(ast.parse(source)) or ""
    kept = KEPT / f"{name}.txt"
    printed = kept.read_text(encoding="utf-8") if kept.is_file() else "No run is kept.\n"
    return f"### {name}\n\n```text\n{told}\n```\n\n```text\n{printed}```\n"


def page() -> str:
    """Return the page, its written part as it is."""
    written = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    return "\n".join([f"{written}{MARK}\n", *map(section, names())])


def main() -> int:
    """Run the named benchmarks and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    asked = parser.parse_args().names
    if unknown := set(asked) - set(names()):
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(names())}")
    failed = [name for name in asked if run(name)]
    PAGE.write_text(page(), encoding="utf-8")
    for name in failed:
        print(f"{name} misses a target", file=sys.stderr)
    return len(failed) > 0


if __name__ == "__main__":
    sys.exit(main())
