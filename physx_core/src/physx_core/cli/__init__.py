"""The command ``physx``. What a verb needs is imported when the verb is used."""

from __future__ import annotations

import importlib
import keyword
import os
import sys
import traceback
from collections.abc import Sequence

from physx_core.errors import PhysxError, UsageError, nearest

VERBS = {
    "plugins": "list the installed plugins, what they bring, and those that are broken",
    "robots": "list the robots that can be given by name, and what collides of them",
    "info": "show a session or dataset: fields, units, samples, normalization, integrity",
    "generate": "make samples with an environment and store them in a session",
    "train": "train a network on a dataset, or on what an environment makes",
    "stats": "show the numbers of a training as a table, or in TensorBoard",
    "verify": "check the files of a dataset, and repair them",
    "export": "write a dataset as npz, parquet, minari, zarr or one HDF5 file",
    "export-network": "write a session's network as a file that runs without physx",
    "import": "make a dataset of an npz or HDF5 file",
    "predict": "put a session's network into a running environment",
    "client": "run an environment for a run that waits for clients, on this machine or another",
    "serve": "let another process drive an environment: Godot clients, trainers, physx",
    "log": "show what was recorded of an episode: table, plot, replay",
    "replay": "send stored samples through their environment, to look at them in a viewer",
}


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


def _run(verb: str, words: list[str]) -> int:
    if verb not in VERBS:
        raise UsageError(f'There is no command "{verb}".{nearest(verb, VERBS)} See physx --help.')
    name = f"{verb}_" if keyword.iskeyword(verb) else verb.replace("-", "_")
    module = importlib.import_module(f"physx_core.cli.{name}")
    try:
        module.run(words)
    except SystemExit as end:  # how the parser ends after --help or a mistake in the options
        return 1 if end.code else 0
    return 0


def _overview() -> str:
    width = max(len(verb) for verb in VERBS)
    verbs = "\n".join(f"  {verb:{width}}  {text}" for verb, text in VERBS.items())
    return (
        "physx: connect physics engines with deep learning (not NVIDIA PhysX)\n\n"
        f"usage: physx COMMAND [OPTIONS]\n\n{verbs}\n\n"
        "physx COMMAND --help lists the command's options. "
        "--debug shows the traceback of an error.\n--version shows the version."
    )


def _message(error: PhysxError, debug: bool) -> str:
    lines = [f"physx: {type(error).__name__}: {error}", *getattr(error, "__notes__", [])]
    remote = getattr(error, "remote_traceback", "")
    if remote and debug:
        lines.append(f"Traceback where the environment runs:\n{remote}")
    elif remote:
        lines.append("(--debug shows the traceback)")
    return "\n".join(lines)
