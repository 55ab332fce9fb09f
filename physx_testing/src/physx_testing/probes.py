"""Environments that launcher checks run in clients."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.components import Environment
from physx_core.fields import Field


class Counting(Environment):
    """Generates random numbers."""

    def create(self) -> None:
        """Do nothing."""

    def init_database(self) -> None:
        """Define the field."""
        self.define_training_fields(Field("numbers", (3,)))

    def step(self) -> None:
        """Draw numbers."""
        self.set_training_data(numbers=self.rng.standard_normal(3))


class Dying(Counting):
    """Ends its process partway through the first run of its second instance."""

    def __init__(self, *, folder: str, **kwargs: Any) -> None:
        """Keep the folder.

        Args:
            folder: Where a file records that it has already died.
            kwargs: See `Environment`.
        """
        super().__init__(**kwargs)
        self._mark = Path(folder) / "died"

    def step(self) -> None:
        """Draw numbers, or die."""
        if self.instance_id == 2 and self.step_index == 3 and not self._mark.exists():
            files.replace(self._mark, b"once")
            os.kill(os.getpid(), signal.SIGKILL)
        super().step()


class Stubborn(Counting):
    """Starts a process, then ignores SIGTERM and never ends a step."""

    def __init__(self, *, mark: str, **kwargs: Any) -> None:
        """Keep the mark.

        Args:
            mark: Value of the variable ``PHYSX_KIT_MARK`` in the process that it starts.
            kwargs: See `Environment`.
        """
        super().__init__(**kwargs)
        self._mark = mark

    def create(self) -> None:
        """Start the process."""
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        variables = {**os.environ, "PHYSX_KIT_MARK": self._mark}
        self._process = subprocess.Popen(["sleep", "600"], env=variables)

    def step(self) -> None:
        """Hang."""
        time.sleep(600)
