"""``physx demo``: simulate, learn, predict, and film the result: a minute, without a GPU."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from physx_core import plugins
from physx_core.cli import options_from, show


@dataclass
class Demo:
    """Let an arm learn its own dynamics, and film how it moves: a minute, without a GPU.

    physx demo

    physx demo --out elsewhere
    """

    out: Path = Path("physx_demo")
    """Folder to write to."""


def run(words: Sequence[str]) -> None:
    """Run the demo, and say what it shows and where it is."""
    options = options_from(Demo, words, "demo")
    from physx_demo import arm

    options.out.mkdir(parents=True, exist_ok=True)
    program = shutil.copy(arm.__file__, options.out)
    viewer = "rerun" if "rerun" in plugins.available() else None
    film = arm.main(options.out, viewer)
    show(f"film: {film}: an arm follows the gray one, (left) under a weak controller alone,")
    show("  (middle) with the torque that the network predicts, (right) with the exact one")
    show(f"program: {program}: all of it in one file; change it, and run it")
    if viewer:
        show(f"recording: physx view {options.out / 'sessions' / 'network'}")
