"""Shows recordings and datasets in a notebook."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
from rerun import notebook

from physx_core.errors import MissingLibraryError, VisualizerError
from physx_rerun.dataset import write_dataset
from physx_rerun.recordings import find


def show(place: str | Path, *, width: int | None = None, height: int | None = None) -> None:
    """Show a recording or a dataset below the notebook's cell.

    Args:
        place: A recording; a session's folder (its newest recording, else its dataset); a
            dataset's folder, or one of its files.
        width: Width in pixels.
        height: Height in pixels.

    Raises:
        MissingLibraryError: If Rerun's widget is not installed.
        PhysxError: If there is neither a recording nor a dataset, or it cannot be read.
    """
    if not notebook.HAS_NOTEBOOK:
        raise MissingLibraryError("show", "rerun-notebook", "notebook", "physx-rerun")
    found = find(place)
    application, recording = "physx dataset", None
    if found.is_file():
        entries = rr.chunk.RrdReader(found).recordings()
        if not entries:
            raise VisualizerError(f"The recording {found} is empty.")
        application, recording = entries[0].application_id, entries[0].recording_id
    stream = rr.RecordingStream(application, recording_id=recording)
    notebook.Viewer(width=width, height=height, recording=stream).display()
    if found.is_file():
        stream.log_file_from_path(found)
    else:
        write_dataset(found, stream)
    stream.flush()
