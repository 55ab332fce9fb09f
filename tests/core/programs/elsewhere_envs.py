"""Environments for clients in another interpreter, which has NumPy and nothing else."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

import physx_core
from physx_core import Environment, Parameter


class Elsewhere(Environment):
    """Tells where it runs."""

    episode_steps = 2

    def create(self):
        """Define what is chosen for each episode."""
        self.define_parameters([Parameter("scale", 1.0, 2.0)])

    def init_database(self):
        """Define a row."""
        self.define_training_fields([("x", float), ("y", float)])

    def reset_parameters(self, scale):
        """Keep the value, and note who got it."""
        self.scale = scale
        said = {
            "prefix": sys.prefix,
            "setting": os.environ.get("SETTING"),
            "packages": [name for name in ("h5py", "xxhash", "rich", "torch") if find_spec(name)],
            "physx": physx_core.__file__,
            "real": os.path.realpath(physx_core.__file__),
            "numpy": sys.modules["numpy"].__file__,
        }
        Path(f"{self.instance_id}.txt").write_text(repr(said))

    def step(self):
        """Draw a number."""
        self.set_training_data(x=self.scale, y=self.rng.uniform())
