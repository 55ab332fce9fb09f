"""Lines of text for people: how wide they may be, and how longer ones are wrapped."""

from __future__ import annotations

import re
import shutil
import textwrap

_COMMAND = re.compile(r"next: | +physx [a-z]")
_LEAST = 30  # columns that a last column needs to be wrapped within itself


def width() -> int:
    """Return the width of the terminal in columns, or of ``COLUMNS``; 80 without either."""
    return shutil.get_terminal_size((80, 24)).columns


def wrapped(text: str) -> str:
    r"""Return a text whose lines are no wider than the terminal, except for words that are.

    What is continued stands below the last column of its line (columns are two blanks apart), or
    is indented further than the line. A command, after ``next: `` or indented, is continued with a
    backslash.
    """
    return "\n".join(piece for line in text.split("\n") for piece in _pieces(line))


def _pieces(line: str) -> list[str]:
    columns = width()
    if len(line) <= columns:
        return [line]
    text = line.lstrip()
    ending = " \\" if _COMMAND.match(line) else ""
    begin = " " * (len(line) - len(text))
    indent = len(begin) + 4
    columns_before, gap, last = text.rstrip().rpartition("  ")
    if gap:
        place = len(begin + columns_before + gap)
        longest = max(_LEAST, *map(len, last.split()))
        indent = place if place + longest <= columns else indent
    pieces = textwrap.wrap(
        text,
        max(20, columns - len(ending)),
        initial_indent=begin,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [*(piece + ending for piece in pieces[:-1]), *pieces[-1:]]
