"""Files of the parameters that instances save, restored when a run goes on from its beginning."""

from __future__ import annotations

from pathlib import Path

from physx_core import files

PARAMETERS = "parameters_{}.bin"
"""Name of the file in a dataset's folder that contains an instance's saved parameters."""
LARGEST_PARAMETERS = 2**32
"""Maximum size of such a file in bytes."""
BEGINS = "parameters.begins"
"""Name of the file that holds the name of a generation that has begun, but has no rows yet."""
_NOW, _BEFORE, _BEFORE_LAST = "", ".begins", ".former"  # suffixes: now, and before generations


def copy_parameters(source: Path, target: Path) -> None:
    """Copy the saved parameters from the folder of one dataset into that of another."""
    for path in source.glob(PARAMETERS.format("*")):
        with files.storing(f"{path}, copied into the session,"):
            files.replace(target / path.name, files.read_content(path, LARGEST_PARAMETERS))


def keep_parameters(directory: Path, generation: str) -> None:
    """Back up the parameters in a dataset's folder when a generation begins.

    If another one was killed before it had rows, nothing goes on with what it saved: the parameters
    that it began with are restored first.

    Args:
        directory: The folder.
        generation: Name of the generation.
    """
    with files.storing(f"{directory}"):
        if (directory / BEGINS).exists():
            _copy(directory, _BEFORE, _NOW)
        _copy(directory, _NOW, _BEFORE)
        files.replace(directory / BEGINS, generation.encode())


def accept_parameters(directory: Path) -> None:
    """Note that the generation has been recorded, so that a later run can go on with it."""
    with files.storing(f"{directory}"):
        _copy(directory, _BEFORE, _BEFORE_LAST)
        files.remove(directory / BEGINS)


def restore_parameters(directory: Path, generation: str) -> None:
    """Restore the parameters with which a recorded generation began.

    Args:
        directory: The dataset's folder.
        generation: Name of the generation.
    """
    with files.storing(f"{directory}"):
        begins = directory / BEGINS
        if begins.exists() and files.read_content(begins, 1 << 12) == generation.encode():
            accept_parameters(directory)  # it was killed in between
        _copy(directory, _BEFORE_LAST, _NOW)
        files.remove(begins)


def _copy(directory: Path, source: str, target: str) -> None:
    """Let files with one suffix be copies of those with another one."""
    every = PARAMETERS.format("*")
    copied = {path.name.removesuffix(source): path for path in directory.glob(every + source)}
    for name, path in copied.items():
        files.replace(directory / (name + target), files.read_content(path, LARGEST_PARAMETERS))
    for path in directory.glob(every + target):
        if path.name.removesuffix(target) not in copied:
            files.remove(path)
