"""``physx view``: open a recording or dataset in the Rerun viewer, or in a browser."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import cli
from physx_core.cli import options_from
from physx_core.errors import VisualizerError
from physx_rerun.notebook import show as show
from physx_rerun.recordings import recording_of
from physx_rerun.viewer.cursor import USUAL_PORT
from physx_rerun.viewer.viewer import Viewer, has_display, start_web_viewer


@dataclass
class View:
    """Open a recording or dataset in the Rerun viewer, or in a browser.

    physx view sessions/prediction

    physx view sessions/data_generation/dataset --web

    physx view sessions/data_generation/dataset --live

    physx view run.rrd --web --port 9876 --page-port 9090
    """

    place: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE|SESSION")]
    """A recording (.rrd), a session's folder (its newest recording, else its dataset), a dataset's
    folder, or one of its files."""
    web: bool = False
    """Serve a page for browsers on this machine, and print its address; Ctrl-C stops it."""
    live: bool = False
    """Listen where physx branch DATASET cursor finds the viewer."""
    port: int = 0
    """Port of the viewer; 0: any free one."""
    page_port: int = 0
    """Port of the page; 0: any free one."""


def run(words: Sequence[str]) -> None:
    """Show the recording until its window is closed or Ctrl-C is pressed.

    Raises:
        VisualizerError: If there is no recording, or if the viewer does not start or fails.
    """
    options = options_from(View, words, "view")
    with recording_of(options.place) as path:
        viewer = _open(path.resolve(), options)
        try:
            with contextlib.suppress(KeyboardInterrupt):  # the usual way to stop it
                if viewer.process.wait():
                    viewer.check()
        finally:
            viewer.end()


def _open(recording: Path, options: View) -> Viewer:
    port = options.port or (USUAL_PORT if options.live else 0)
    if options.web:
        viewer = start_web_viewer(port, options.page_port, str(recording))
        cli.show(f"viewer: {viewer.page}  (Ctrl-C stops it)")
        return viewer
    if not has_display():
        raise VisualizerError(
            "There is no display to open a window on. Add --web to view it in a browser, or render "
            "a picture: physx snapshot FILE|SESSION -o PICTURE.png"
        )
    viewer = Viewer(port, (str(recording),))
    viewer.wait_until_ready()
    return viewer
