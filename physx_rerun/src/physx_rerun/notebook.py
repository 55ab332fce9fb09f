"""Shows recordings and datasets in a notebook."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
from rerun import notebook

from physx_core import cli
from physx_core.cli import in_notebook
from physx_core.errors import MissingLibraryError, VisualizerError
from physx_core.processes import TemporaryFolder
from physx_rerun.dataset import write_dataset
from physx_rerun.recordings import find, recording_of
from physx_rerun.stored_meshes import TIMELINE
from physx_rerun.viewer.headless import render_picture

_SIZE = (960, 540)
"""Width and height of a picture, in pixels."""


def show(
    place: str | Path,
    *,
    row: int | None = None,
    width: int | None = None,
    height: int | None = None,
) -> None:
    """Show a recording or a dataset in Rerun's widget below the notebook's cell.

    If the widget is not installed, a picture is shown; outside of a notebook, a picture is written
    to the working directory, and its path is printed.

    Args:
        place: A recording; a session's folder (its newest recording, else its dataset); a
            dataset's folder, or one of its files.
        row: Number of the row of a dataset where the cursor stands; None: the end of the recording
            or dataset.
        width: Width in pixels.
        height: Height in pixels.

    Raises:
        MissingLibraryError: If Rerun's widget is not installed, and no picture can be drawn.
        PhysxError: If there is neither a recording nor a dataset, or it cannot be read.
    """
    if in_notebook() and notebook.HAS_NOTEBOOK:
        _show_widget(find(place), row, width, height)
        return
    size = (width or _SIZE[0], height or _SIZE[1])
    at, timeline = (None, None) if row is None else (row, TIMELINE)
    with recording_of(place) as recording, TemporaryFolder("rerun-") as folder:
        picture = Path(recording.name).with_suffix(".png")
        if not in_notebook():
            cli.show(f"picture: {render_picture(recording, picture, size, at, timeline)}")
            return
        from IPython.display import Image, display

        try:
            found = render_picture(recording, folder.path / picture, size, at, timeline)
        except VisualizerError as error:
            missing = ("show", "rerun-notebook", "notebook", "physx-rerun")
            raise MissingLibraryError(*missing) from error
        display(Image(found.read_bytes()))


def _show_widget(found: Path, row: int | None, width: int | None, height: int | None) -> None:
    """Show the file of a recording, or the folder of a dataset, in Rerun's widget."""
    application, recording = "physx dataset", None
    if found.is_file():
        entries = rr.chunk.RrdReader(found).recordings()
        if not entries:
            raise VisualizerError(f"The recording {found} is empty.")
        application, recording = entries[0].application_id, entries[0].recording_id
    stream = rr.RecordingStream(application, recording_id=recording)
    viewer = notebook.Viewer(width=width, height=height, recording=stream)
    viewer.display()
    if found.is_file():
        stream.log_file_from_path(found)
    else:
        write_dataset(found, stream)
    stream.flush()
    if row is not None:
        viewer.set_time_ctrl(sequence=row, timeline=TIMELINE)
