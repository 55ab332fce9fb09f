"""Help texts of commands: wraps them, and reads the commands' options from them."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TextIO

from physx_core.terminal import width, wrapped

_OPTION = re.compile(
    r"^[│ ]*(?:-\w, )?(--[a-z][\w.-]*)(?:, (--[a-z][\w.-]*))?(?: (\S.*?))?(?:  |│|$)"
)
_STYLE = re.compile(r"\x1b\[[0-9;]*m")


class _Captured(io.StringIO):
    """What is printed for the stream that it replaces, in color if that is a terminal."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream

    def isatty(self) -> bool:
        return self._stream.isatty()


@contextlib.contextmanager
def wrapped_help() -> Iterator[None]:
    """Wrap what is printed meanwhile: parsers wrap options, but neither usages nor descriptions."""
    printed = _Captured(sys.stdout)
    try:
        with contextlib.redirect_stdout(printed):
            yield
    finally:
        for line in printed.getvalue().splitlines():
            plain = _STYLE.sub("", line)
            if len(plain) <= width():
                print(line)
            else:
                hangs = plain.startswith((" ", "usage:"))
                print(wrapped(plain) if hangs else textwrap.fill(plain, width()))


def help_of(run: Callable[[Sequence[str]], object]) -> str:
    """Return the help text of a command, at most 80 columns wide.

    Args:
        run: Takes the words after the command.
    """
    os.environ["COLUMNS"] = "80"  # each option on its own line
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        run(["--help"])
    return printed.getvalue()


def options_in(text: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield the options of a help text, each with its metavariable and its description."""
    names: tuple[str, ...] = ()
    metavar = description = ""
    for line in [*text.splitlines(), "╰"]:
        match = _OPTION.match(line)
        if match or line.startswith("╰"):
            for name in names:
                yield name, (metavar, description)
            names, description = (), ""
        if match:
            names = tuple(name for name in match.groups()[:2] if name)
            metavar, description = match[3] or "", line[match.end() :]
        else:
            description += line


def suggest(
    words: Sequence[str], own: Collection[str], find: Callable[[str], list[str]]
) -> Iterator[str]:
    """Yield what may be meant by the options among the words that a command does not have.

    Args:
        words: The words after the command.
        own: Its options.
        find: Returns the commands that have an option.
    """
    given = (word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--"))
    for option in dict.fromkeys(given):
        if option in own or any(option.startswith(f"{each}.") for each in own):
            continue
        longer = sorted(each for each in own if each.endswith(f".{option[2:]}"))
        if longer:
            yield f"{option}: did you mean {' or '.join(longer)}?"
        elif others := find(option):
            yield f"{option} is an option of {', '.join(others)}."
