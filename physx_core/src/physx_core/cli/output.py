"""Prints the output of commands."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from physx_core.cells import in_notebook as in_notebook
from physx_core.errors import printable
from physx_core.terminal import width as width
from physx_core.terminal import wrapped

_LONGEST = 16  # characters of a word that a table keeps together


def show(found: Any = "", *, as_json: bool = False) -> None:
    """Print what was found, or a text: wrapped, and no name in it controls the terminal.

    Args:
        found: What to print.
        as_json: Whether to print what its ``to_json`` returns instead, for programs.
    """
    print(found.to_json() if as_json else wrapped(printable(found)))


def show_values(values: Mapping[str, str]) -> None:
    """Print texts by name, indented."""
    for name, text in values.items():
        show(f"  {name:<11}  {text}")


def show_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    numbers: Collection[str] = (),
    curve: str | None = None,
    indent: int = 0,
) -> None:
    """Print a table as wide as the terminal, in color only on a terminal.

    Args:
        head: Names of the columns.
        rows: The cells' texts. Text that is too long for its column wraps to the next line, where
            possible between words.
        numbers: Columns of numbers, which never wrap.
        curve: Column of spark lines.
        indent: Spaces before each line.
    """
    from rich.console import Console  # imported only when needed, to keep `physx --help` fast
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = Console(file=sys.stdout, highlight=False, width=width())
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name, column in zip(head, zip(head, *rows, strict=True), strict=True):
        wraps = name not in numbers and name != curve
        words = [len(word) for text in column for word in text.split()]
        table.add_column(
            Text(name, "bold"),
            justify="right" if name in numbers else "left",
            style="cyan" if name == curve else "",
            no_wrap=not wraps,
            min_width=min(max(words, default=0), _LONGEST) if wraps else None,
            overflow="fold",
        )
    for row in rows:
        table.add_row(*(Text(printable(text)) for text in row))
    with console.capture() as captured:
        console.print(Padding(table, (0, 0, 0, indent)))
    for line in captured.get().splitlines():
        print(line.rstrip())
