"""The command ``physx``. What a verb needs is imported when the verb is used."""

from __future__ import annotations

import ast
import importlib.util
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from physx_core.errors import PhysxError, UsageError, nearest

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "physx.commands"
"""Entry-point group of the commands: name of the command, module with a function ``run(words)``."""
_PACKAGES = {"log": "physx-gym", "robots": "physx-dart", "serve": "physx-remote"}
"""Commands of the physx project that other distributions bring."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, 1 after an error, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if words[0] == "--version":
        from physx_core import __version__

        print(f"physx {__version__}")
        return 0
    try:
        return _run(words[0], words[1:])
    except PhysxError as error:
        if debug:
            traceback.print_exception(error)
        print(_message(error, debug), file=sys.stderr)
        return 1
    except BrokenPipeError:  # who read the output has enough, as in  physx info DIR | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print("physx: interrupted; everything that was committed is kept", file=sys.stderr)
        return 130


def _run(name: str, words: list[str]) -> int:
    commands = _commands()
    if name not in commands:
        if name in _PACKAGES:
            package = _PACKAGES[name]
            raise UsageError(f"physx {name} belongs to {package}: pip install {package}")
        guess = nearest(name, commands)
        raise UsageError(f'There is no command "{name}".{guess} See physx --help.')
    module = commands[name].load()
    try:
        module.run(words)
    except SystemExit as end:  # how the parser ends after --help or a mistake in the options
        return 1 if end.code else 0
    return 0


def _commands() -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))}


def _overview() -> str:
    commands = _commands()
    width = max(map(len, commands), default=0)
    lines = "\n".join(f"  {name:{width}}  {_summary(entry)}" for name, entry in commands.items())
    return (
        "physx: connect physics engines with deep learning (not NVIDIA PhysX)\n\n"
        f"usage: physx COMMAND [OPTIONS]\n\n{lines}\n\n"
        "physx COMMAND --help lists the command's options. "
        "--debug shows the traceback of an error.\n--version shows the version."
    )


def _summary(entry: EntryPoint) -> str:
    """Return the first line of a command's module, which is read but not imported."""
    package, *module = entry.value.split(".")
    try:
        spec = importlib.util.find_spec(package)
        folders = (spec and spec.submodule_search_locations) or []
        source = Path(folders[0], *module).with_suffix(".py").read_text()
        text = ast.get_docstring(ast.parse(source)) or ""
    except (ImportError, OSError, IndexError, SyntaxError, ValueError) as error:
        return f"(broken: {error})"  # a broken package breaks its own command only
    return text.partition("\n")[0].partition(": ")[2].rstrip(".")


def _message(error: PhysxError, debug: bool) -> str:
    lines = [f"physx: {type(error).__name__}: {error}", *getattr(error, "__notes__", [])]
    remote = getattr(error, "remote_traceback", "")
    if remote and debug:
        lines.append(f"Traceback where the environment runs:\n{remote}")
    elif remote:
        lines.append("(--debug shows the traceback)")
    return "\n".join(lines)
