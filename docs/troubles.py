"""Writes docs/troubles.md: what others reported about other software, and the tests of it here.

python docs/troubles.py    # reads the marks ``reported`` of the tests
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
TESTS = HERE.parent / "tests"
PAGE = HERE / "troubles.md"
BEGIN = """\
# Troubles of others

What users of simulators, of datasets, and of trainers have reported, and what physx does there.
Each line names the reports, as numbers in the projects' trackers, and a test that shows it; the
tests run with all others. A report says what was so when it was written, and nothing here says how
these projects are today.

| reported | by | test |
|---|---|---|
"""


def reports() -> Iterator[tuple[str, list[str], str]]:
    """Yield what was reported, where, and the test of it, in the order of files and lines."""
    for file in sorted(TESTS.rglob("test_*.py")):
        text = file.read_text(encoding="utf-8")
        if "mark.reported" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.reported":
                    [about] = [ast.literal_eval(each.value) for each in mark.keywords]
                    where = [ast.literal_eval(each) for each in mark.args]
                    yield about, where, f"{file.relative_to(TESTS.parent)}::{node.name}"


def page() -> str:
    """Return the page."""
    rows = [f"| {about} | {', '.join(where)} | `{test}` |" for about, where, test in reports()]
    return BEGIN + "\n".join(rows) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
