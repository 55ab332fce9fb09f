"""Files of what instances saved with `save_parameters`, as streams begin with them."""

from __future__ import annotations

from pathlib import Path

from physx_core import files
from physx_core.dataset import Dataset

PARAMETERS = "parameters_{}.bin"
"""Name of the file in a dataset's folder that contains an instance's saved parameters."""
LARGEST_PARAMETERS = 2**32
"""Maximum size of such a file in bytes."""
BEGUN = "parameters.begun"
"""Name of the file that says which streams have begun, but are not described in the dataset."""
_BEGUN = ".begun"
_ALL, _OF_STREAMS = PARAMETERS.format("*"), PARAMETERS.format("[1-9]*")


def copy_parameters(directory: Path, to: Path) -> None:
    """Replace the files in a dataset's folder by copies of those in another one.

    Args:
        directory: The other one.
        to: The folder.
    """
    _copy(directory, to, _ALL)


def _copy(directory: Path, to: Path, which: str, of: str = "", become: str = "") -> None:
    """Replace files by copies of others, whose names end differently."""
    with files.storing(f"{to}"):
        names = {path.name.removesuffix(of) for path in directory.glob(which + of)}
        for path in to.glob(which + become):
            if path.name.removesuffix(become) not in names:
                files.remove(path)
        for name in names:
            content = files.read_content(directory / f"{name}{of}", LARGEST_PARAMETERS)
            files.replace(to / f"{name}{become}", content)


def remove_unused_parameters(dataset: Dataset) -> None:
    """Remove what instances saved of a dataset that has no samples, as nothing goes on with it."""
    if any(dataset.num_samples(mode) for mode in dataset.modes):
        return
    with files.storing(f"{dataset.directory}"):
        for path in dataset.directory.glob(_ALL):
            files.remove(path)


def keep_parameters(directory: Path, streams: str) -> None:
    """Back up the parameters with which streams begin.

    If those that began before were never described, nothing goes on with what they saved: the
    parameters that they began with are restored first.

    Args:
        directory: The dataset's folder.
        streams: Name of the streams: `Generation.name`.
    """
    if (directory / BEGUN).exists():
        _copy(directory, directory, _OF_STREAMS, _BEGUN)
    _copy(directory, directory, _OF_STREAMS, become=_BEGUN)
    with files.storing(f"{directory}"):
        files.replace(directory / BEGUN, streams.encode())


def accept_parameters(directory: Path, entry: str) -> None:
    """Keep the backup for runs that go on with streams, now that the dataset describes them.

    Args:
        directory: The dataset's folder.
        entry: Entry of the dataset's info that describes them.
    """
    _copy(directory, directory, _OF_STREAMS, _BEGUN, f".{entry}")
    forget_parameters(directory)


def restore_parameters(directory: Path, entry: str, streams: str) -> None:
    """Restore the parameters with which streams began.

    Args:
        directory: The dataset's folder.
        entry: Entry of the dataset's info that describes them.
        streams: Name of the streams: `Generation.name`.
    """
    begun = directory / BEGUN
    with files.storing(f"{directory}"):
        is_accepted = not begun.exists() or files.read_content(begun, 2**16) != streams.encode()
    if not is_accepted:  # the run was killed just before
        accept_parameters(directory, entry)
    _copy(directory, directory, _OF_STREAMS, f".{entry}")
    forget_parameters(directory)


def end_without_rows(directory: Path) -> None:
    """Remove the backup of streams that end without rows, unless they have saved something."""
    with files.storing(f"{directory}"):
        now, before = (
            {
                path.name.removesuffix(end): files.read_content(path, LARGEST_PARAMETERS)
                for path in directory.glob(_OF_STREAMS + end)
            }
            for end in ("", _BEGUN)
        )
    if now == before:
        forget_parameters(directory)


def forget_parameters(directory: Path) -> None:
    """Remove the backup of streams that the dataset does not describe."""
    with files.storing(f"{directory}"):
        files.remove(directory / BEGUN)
        for path in directory.glob(_OF_STREAMS + _BEGUN):
            files.remove(path)
