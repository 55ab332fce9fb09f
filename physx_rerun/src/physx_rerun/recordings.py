"""Finds the recording of a session, and makes one of a dataset."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import rerun as rr

from physx_core.errors import VisualizerError
from physx_core.processes import TemporaryFolder
from physx_rerun.dataset import write_dataset
from physx_rerun.importer import find_dataset


@contextlib.contextmanager
def recording_of(place: str | Path) -> Iterator[Path]:
    """Provide the recording of something that was recorded or generated.

    Args:
        place: A recording; a session's folder, of which the newest recording is taken, or else the
            dataset; a dataset's folder, or one of its files.

    Raises:
        VisualizerError: If there is neither a recording nor a dataset.
        PhysxError: If the dataset cannot be read.
    """
    path = Path(place)
    if path.suffix == ".rrd" and path.is_file():
        yield path
        return
    recordings = sorted(path.glob("*.rrd"), key=lambda file: file.stat().st_mtime)
    folder = find_dataset(path)
    if recordings:
        yield recordings[-1]
    elif folder is not None:
        with TemporaryFolder("rerun-") as temporary:
            file = temporary.path / f"{path.resolve().stem}.rrd"
            stream = rr.RecordingStream("physx dataset")
            stream.save(file)
            stream.send_recording_name(path.resolve().stem)
            try:
                write_dataset(folder, stream)
            finally:
                stream.disconnect()
            yield file
    elif path.exists():
        raise VisualizerError(
            f"{path} is neither a recording (.rrd) nor a dataset, and holds none. Runs with "
            "--environment.visualizer rerun leave a recording in their session."
        )
    else:
        raise VisualizerError(f"There is no recording, session or dataset {path}.")
