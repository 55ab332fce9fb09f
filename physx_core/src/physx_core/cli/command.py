"""The command ``physx``, whose subcommands are entry points, imported when used."""

from __future__ import annotations

import contextlib
import faulthandler
import functools
import importlib.util
import io
import os
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from physx_core.errors import PhysxError, UsageError, printable
from physx_core.plugins.commands import find_command
from physx_core.plugins.entries import COMMANDS, describe_conflict, find_entries
from physx_core.processes import Terminated, describe_ending, ends_in, raised_at_sigterm

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_ORDER = (
    *("generate", "train", "predict", "replay", "branch", "info", "stats", "verify"),
    *("export", "import", "export-network", "client", "include", "plugins", "new", "check"),
    "doctor",
    "completion",
)
"""Order of the core's commands in the overview; others follow alphabetically."""
_HELP = {"-h", "--help"}
_USAGE = 2  # the status of a parser that does not understand its words


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    Returns:
        0 on success; 1 after an error; 130 after Ctrl-C; 143 after SIGTERM, which ends a command as
        cleanly as Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        _show_crashes()
        with raised_at_sigterm(), contextlib.nullcontext() if debug else _short_warnings():
            return _dispatch(words)
    except PhysxError as error:
        if debug:
            sys.stderr.write(printable("".join(traceback.format_exception(error))))
        print(printable(_message(error, debug)), file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader closed the pipe, as in  physx info DIR | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt as error:
        return _interrupted(error, "interrupted", signal.SIGINT)
    except Terminated as error:
        return _interrupted(error, "terminated", signal.SIGTERM)
    except SystemExit as end:  # the parser's, after --help or an invalid option, or a command's
        return 1 if end.code else 0


def _show_crashes() -> None:
    """Print a traceback if an engine or a plugin crashes."""
    if not faulthandler.is_enabled():
        with contextlib.suppress(io.UnsupportedOperation, AttributeError):  # there is no stderr
            faulthandler.enable()


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    """Show warnings on one line, without their source location."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        return printable(f"physx: {category.__name__}: {message}") + "\n"

    usual = warnings.formatwarning
    warnings.formatwarning = show
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _interrupted(error: BaseException, how: str, number: signal.Signals) -> int:
    text = "; ".join([how, *getattr(error, "__notes__", [])])
    print(f"physx: {printable(text)}", file=sys.stderr)
    return 128 + number


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in _HELP:
        print(_overview())
        return 0
    if words[0] == "--version":
        from physx_core import __version__

        print(f"physx {__version__}")
        return 0
    _run(words[0], words[1:])
    return 0


def _run(name: str, words: list[str]) -> None:
    module = find_command(name)
    try:
        with contextlib.nullcontext() if _HELP.isdisjoint(words) else _wrapped_help():
            module.run(words)
    except SystemExit as end:
        if end.code == _USAGE:
            for line in _suggestions(name, words):
                print(f"physx: {printable(line)}", file=sys.stderr)
        ours = module.__name__.partition(".")[0]
        if end.code or not ours.startswith("physx_") or ends_in(end, "argparse", "tyro", ours):
            raise
        raise UsageError(f"{describe_ending(end)}, but the command is not finished.") from end


def _wrapped_help() -> contextlib.AbstractContextManager[None]:
    from physx_core.cli.help_texts import wrapped_help

    return wrapped_help()


def _suggestions(name: str, words: list[str]) -> Iterator[str]:
    """Yield what may be meant by options that a command does not have."""
    from physx_core.cli.help_texts import help_of, options_in, suggest

    @functools.cache
    def options_of(command: str) -> set[str]:
        return {each for each, _ in options_in(help_of(commands[command][0].load().run))}

    def find(option: str) -> list[str]:
        found = []
        for command in commands:
            with contextlib.suppress(Exception):  # a broken command breaks only itself
                found += [f"physx {command}"] if option in options_of(command) else []
        return found

    commands = find_entries(COMMANDS)
    yield from suggest(words, options_of(name), find)


def _overview() -> str:
    commands = find_entries(COMMANDS)
    names = [name for name in _ORDER if name in commands]
    names += [name for name in commands if name not in _ORDER]
    shown = {name: printable(name) for name in names}
    width = max(map(len, shown.values()), default=0)
    indent = " " * (width + 4)
    lines = "\n".join(
        textwrap.fill(
            printable(_summary(commands[name])),
            80,
            initial_indent=f"  {shown[name]:{width}}  ",
            subsequent_indent=indent,
        )
        or f"  {shown[name]}"  # without a summary
        for name in names
    )
    return (
        "physx: connect physics engines with deep learning (not NVIDIA PhysX)\n\n"
        f"usage: physx COMMAND [OPTIONS]\n\n{lines}\n\n"
        "physx COMMAND --help lists the command's options.\n"
        "--debug shows the traceback of an error, --version the version."
    )


def _summary(entries: list[EntryPoint]) -> str:
    """Return the first docstring line of a command's module, without importing it."""
    if len(entries) > 1:
        return f"(broken: {describe_conflict('command', entries)})"
    package, *module = entries[0].value.split(".")
    try:
        spec = importlib.util.find_spec(package)
        if spec is None:
            return f"(broken: there is no module {package})"
        folders = spec.submodule_search_locations or []
        path = Path(folders[0], *module).with_suffix(".py") if module else Path(spec.origin or "")
        line = path.read_text().lstrip().partition("\n")[0]
    except (ImportError, OSError, IndexError, ValueError) as error:
        return f"(broken: {error})"  # a broken package breaks only its own command
    return line.partition(": ")[2].rstrip('."') if line.startswith('"""') else ""


def _message(error: PhysxError, debug: bool) -> str:
    lines = [f"physx: {type(error).__name__}: {error}", *getattr(error, "__notes__", [])]
    remote = getattr(error, "remote_traceback", "")
    if remote and debug:
        lines.append(f"Traceback from the environment's process:\n{remote}")
    elif remote:
        lines.append("(--debug shows the traceback)")
    return "\n".join(lines)
