"""Finds the recording of a session, or creates one from a dataset."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import rerun as rr

from physx_core.errors import VisualizerError, found_at
from physx_core.processes import TemporaryFolder
from physx_rerun.dataset import write_dataset
from physx_rerun.importer import find_dataset


def find(place: str | Path) -> Path:
    """Return the file of a recording or the folder of a dataset.

    Args:
        place: A recording; a session's folder (its newest recording, else its dataset); a
            dataset's folder, or one of its files.

    Raises:
        VisualizerError: If there is neither a recording nor a dataset.
    """
    path = Path(place)
    if not path.exists():
        raise VisualizerError(f"There is no recording, session or dataset {path}. {found_at(path)}")
    if path.suffix == ".rrd" and path.is_file():
        return path
    recordings = sorted(path.glob("*.rrd"), key=lambda file: file.stat().st_mtime)
    found = recordings[-1] if recordings else find_dataset(path)
    if found is None:
        raise VisualizerError(
            f"{path} is neither a recording (.rrd) nor a dataset, and contains none. Runs with "
            "--environment.visualizer rerun save a recording in their session."
        )
    return found


@contextlib.contextmanager
def recording_of(place: str | Path) -> Iterator[Path]:
    """Provide the file of a recording, for a dataset a temporary one; see `find`.

    Raises:
        PhysxError: If there is none, or the dataset cannot be read.
    """
    found = find(place)
    if found.is_file():
        yield found
        return
    with TemporaryFolder("rerun-") as temporary:
        name = Path(place).resolve().stem
        file = temporary.path / f"{name}.rrd"
        stream = rr.RecordingStream("physx dataset")
        stream.save(file)
        stream.send_recording_name(name)
        try:
            write_dataset(found, stream)
        finally:
            stream.disconnect()
        yield file
