"""``physx snapshot``: render a picture of a recording or dataset at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core.cli import options_from, show
from physx_core.errors import UsageError
from physx_rerun.recordings import recording_of
from physx_rerun.viewer.headless import render_picture


@dataclass
class Snapshot:
    """Render a picture of a recording or dataset at one time, without a display.

    physx snapshot sessions/prediction

    physx snapshot run.rrd --at 150 -o run.png

    physx snapshot run.rrd --at 1.5s --width 800 --height 600 -o run.png
    """

    place: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE|SESSION")]
    """A recording (.rrd), a session's folder (its newest recording, else its dataset), a dataset's
    folder, or one of its files."""
    at: str | None = None
    """A step such as 150, a simulated time such as 1.5s, or a position on --timeline; by default
    the end."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Picture to write; by default in this folder, named after the recording."""
    timeline: str | None = None
    """Name of the timeline, for example sim_time or epoch."""
    width: int = 1600
    """Width in pixels."""
    height: int = 900
    """Height in pixels."""


def run(words: Sequence[str]) -> None:
    """Render the picture and print its path."""
    options = options_from(Snapshot, words, "snapshot")
    timeline, at = options.timeline, _position(options.at)
    if timeline is None and options.at is not None and options.at.endswith("s"):
        timeline = "sim_time"
    with recording_of(options.place) as recording:
        picture = options.out or Path(recording.name).with_suffix(".png")
        render_picture(recording, picture, (options.width, options.height), at, timeline)
    show(f"picture: {picture}")


def _position(text: str | None) -> float | None:
    try:
        return None if text is None else float(text.removesuffix("s"))
    except ValueError:
        raise UsageError(
            f'--at is "{text}" but must be a number such as 150, or a time such as 1.5s.'
        ) from None
