"""``python -m physx_rerun FILE.rrd OUT.png``: render a picture of a recording."""

from __future__ import annotations

import argparse
import sys

from physx_core import PhysxError
from physx_rerun.viewer.headless import render_picture


def main() -> int:
    """Parse the command line, render the picture, and return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m physx_rerun", description=__doc__)
    parser.add_argument("recording", help="the recording, a .rrd file")
    parser.add_argument("picture", help="picture to write, a .png file")
    parser.add_argument("--width", type=int, default=1600, help="in pixels")
    parser.add_argument("--height", type=int, default=900, help="in pixels")
    parser.add_argument("--step", type=int, help="position on the timeline; default: its end")
    parser.add_argument("--timeline", default="step", help="name of the timeline")
    given = parser.parse_args()
    size = (given.width, given.height)
    try:
        render_picture(given.recording, given.picture, size, given.step, given.timeline)
    except PhysxError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
