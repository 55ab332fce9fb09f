"""The Franka Panda tracks trajectories with a weak joint controller and a feedforward torque."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import PhysxError
from physx_core.pipelines import Learner
from physx_dart import DartArm
from physx_rerun import render_film, render_picture

SHOWN = {"PD alone": "none", "PD + network": "network", "PD + exact model": "model"}
TRAJECTORIES = (5, 6, 7)
Torque = str | Callable[[np.ndarray], np.ndarray]


class ComparedArm(DartArm):
    """Arms side by side on the same trajectory, each with a different feedforward torque."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(task="track", **kwargs)
        self.variant, self.feedforward = list(SHOWN.items())[self.instance_id - 1]

    def init_visualization(self) -> None:
        self.factory.set_view(self.variant)
        super().init_visualization()


def predicted(learner: Learner) -> Torque:
    """Return a function that predicts the feedforward torque with a network."""
    return lambda state: learner.predict({"state": state})["torque"]


def tracking_error(torque: Torque, trajectory: int, steps: int) -> float:
    """Run an arm along a trajectory and return the mean error of its seven joints, in mrad.

    The feedforward torque is one that `DartArm` knows ("none", "gravity", "model"), or a function
    that maps the reference (q, v, a), shape (1, 27), to torques, shape (1, 9).
    """
    feedforward = torque if isinstance(torque, str) else "network"
    with closing(DartArm(task="track", trajectory=trajectory, feedforward=feedforward)) as arm:
        arm.create()
        arm.init()
        errors = []
        for _ in range(steps):
            arm.step()
            sample = arm.take_sample()
            errors.append(sample["tracking_error"])
            if callable(torque):
                arm.apply_prediction({"torque": torque(sample["state"][None])[0]})
    return 1e3 * float(np.mean(errors))


def draw(recording: Path, picture: Path | None, steps: int) -> None:
    """Draw a recording as a film (.webp), or its middle as a picture; next to it by default."""
    drawn = picture or recording.with_suffix(".png")
    try:
        if drawn.suffix == ".webp":
            render_film(recording, drawn, (880, 496), frames=steps // 20, frame_rate=10)
        else:
            render_picture(recording, drawn, at=steps // 2)
        print(f"picture: {drawn}", file=sys.stderr)
    except PhysxError as error:
        if picture:
            raise
        print(f"no picture: {error}", file=sys.stderr)
