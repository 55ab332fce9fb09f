"""``rerun-importer-physx``: lets ``rerun FILE.h5`` open a dataset.

Rerun calls it for each file that it opens, so it checks the name before it imports anything.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

FOREIGN = 66
"""Exit status for files that are not datasets, as specified by Rerun."""


def find_dataset(path: Path) -> Path | None:
    """Return the folder of the dataset that a file belongs to, or that a folder is or contains.

    Args:
        path: An HDF5 file or the manifest of a dataset, or the folder of a dataset or its session.
    """
    folders = [path, path / "dataset"]
    if path.suffix == ".h5" or path.name == "dataset.json":
        folders = [path.parent]
    return next((folder for folder in folders if (folder / "dataset.json").is_file()), None)


def main() -> int:
    """Write the recording of a dataset to the standard output, and return the exit status."""
    parser = argparse.ArgumentParser(prog="rerun-importer-physx", description=__doc__)
    parser.add_argument("file")
    parser.add_argument("--application-id", default="physx dataset")
    parser.add_argument("--recording-id")
    given, _ = parser.parse_known_args()
    path = Path(given.file)
    folder = None if path.is_dir() else find_dataset(path)
    if folder is None:  # Rerun opens the files of a folder one by one
        return FOREIGN

    import rerun as rr

    from physx_core import PhysxError
    from physx_rerun.dataset import write_dataset

    stream = rr.RecordingStream(given.application_id, recording_id=given.recording_id)
    stream.stdout()
    try:
        write_dataset(folder, stream)
    except PhysxError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 1
    finally:
        stream.disconnect()
    return 0
