"""Runs benchmarks, keeps what they print in docs/figures/, and shows it in docs/figures.md.

python docs/figures.py NAME ...    # runs benchmarks/NAME.py: minutes, on a quiet machine
python docs/figures.py             # writes the page from what is kept
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import kept

HERE = Path(__file__).resolve().parent
BENCHMARKS = HERE.parent / "benchmarks"
# Those that others start, that compare two versions, or that write a page of their own:
OTHERS = {"compare", "jiminy_zoo", "many_clients", "remote_servers", "robots", "transport_costs"}


def names() -> list[str]:
    """Return the names of all benchmarks."""
    found = {
        path.stem
        for path in BENCHMARKS.glob("*.py")
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    }
    return sorted(found - OTHERS)


def run(name: str) -> int:
    """Run a benchmark and return its exit status."""
    return PAGE.keep(name, [sys.executable, str(BENCHMARKS / f"{name}.py")])


def section(name: str) -> str:
    """Return what the page says of a benchmark."""
    source = (BENCHMARKS / f"{name}.py").read_text(encoding="utf-8")
    told = ast.get_docstring(ast.parse(source)) or ""
    return f"### {name}\n\n```text\n{told}\n```\n\n{PAGE.printed(name)}"


PAGE = kept.Page(HERE / "figures.md", HERE / "figures", names, run, section)

if __name__ == "__main__":
    sys.exit(PAGE.main(__doc__ or ""))
