"""Environments that note where they run."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from pathlib import Path

import numpy as np

from physx_core import Environment


class Walk(Environment):
    """A random walk in a client that has a process of its own.

    Each client leaves a file INSTANCE-PID-CHILD-NODE in the folder `notes`, and takes no step while
    there is a file of the name `hold` beside that folder.
    """

    def __init__(self, *, notes: str, pace: float = 0.0, fail_at: int = -1, **kwargs):
        super().__init__(**kwargs)
        self.notes, self.pace, self.fail_at = Path(notes), pace, fail_at
        self.position = np.zeros(3)

    def create(self):
        self.child = subprocess.Popen(["sleep", "1000"])
        node = os.environ.get("RAY_RAYLET_PID") or os.environ.get("SLURM_JOB_ID") or "here"
        name = f"{self.instance_id}-{os.getpid()}-{self.child.pid}-{node}-{socket.gethostname()}"
        (self.notes / name).touch()

    def init_database(self):
        self.define_training_fields(("position", np.ndarray))

    def step(self):
        if self.step_index == self.fail_at:
            raise RuntimeError("on purpose")
        while (self.notes.parent / "hold").exists():
            time.sleep(0.02)
        time.sleep(self.pace)
        self.position = self.position + self.rng.normal(size=3)
        self.set_training_data(position=self.position)

    def close(self):
        self.child.kill()
        self.child.wait()


class Trips(Walk):
    """Independent random walks of ten steps."""

    episode_steps = 10

    def reset_parameters(self):
        self.position = np.zeros(3)
