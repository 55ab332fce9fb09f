"""Weights & Biases: an observer that writes statistics as a run, offline by default."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from physx_core.components import Observer
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.typing import Array

_MODES = ("offline", "online")
_BINS = 64
_TIMELINES = ("batch", "epoch", "step")


class WandB(Observer):
    """Writes numbers and histograms to the session's ``stats/wandb`` as a W&B run.

    Nothing leaves the machine unless `mode` is ``"online"``; ``wandb sync`` uploads a run later.
    Only system information that W&B needs is recorded: no output, code, or machine statistics.
    """

    def __init__(
        self,
        project: str = "physx",
        mode: Literal["offline", "online"] = "offline",
        interval: float = 0.1,
    ) -> None:
        """Set the options.

        Args:
            project: Name of the W&B project.
            mode: ``"online"`` uploads everything immediately, to the account logged in to W&B.
            interval: Shortest time in s between two points of a curve over batches.

        Raises:
            ConfigError: If the mode does not exist, or the interval is negative.
        """
        if mode not in _MODES:
            raise ConfigError(f'mode is "{mode}" but must be one of: {", ".join(_MODES)}.')
        if interval < 0:
            raise ConfigError("interval must not be negative.")
        self._project, self._mode, self._interval = project, mode, interval
        self._run: Any = None
        self._waiting: dict[str, dict[str, float]] = {}
        self._written = float("-inf")
        self._folder: Path | None = None
        self._known: set[str] = set()

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Start a run next to those of the session's earlier runs.

        Raises:
            MissingLibraryError: If Weights & Biases is not installed.
        """
        try:
            import wandb
        except ImportError as error:
            raise MissingLibraryError(
                "Writing for Weights & Biases", "wandb", "wandb", "physx-torch"
            ) from error
        self._folder = None
        folder = session_dir.absolute() / "stats"
        folder.mkdir(parents=True, exist_ok=True)
        settings = wandb.Settings(
            console="off",
            disable_code=True,
            disable_git=True,
            silent=True,
            x_disable_stats=True,
            x_save_requirements=False,
        )
        self._run = wandb.init(
            project=self._project,
            name=run_name,
            dir=folder,
            mode=self._mode,
            settings=settings,
            reinit="create_new",
        )
        for timeline in _TIMELINES:
            self._run.define_metric(timeline, hidden=True)
        self._known = set(_TIMELINES)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Write the numbers over their timeline; those of batches at a limited rate."""
        if self._run is None:
            return
        waiting = self._waiting.setdefault(timeline, {})
        waiting.update(values)
        waiting[timeline] = step
        now = time.monotonic()
        if timeline != "batch" or now - self._written >= self._interval:
            self._written = now
            self._write_waiting()

    def _write_waiting(self) -> None:
        for timeline, values in self._waiting.items():
            self._log(values, timeline)
        self._waiting.clear()

    def _log(self, values: dict[str, Any], timeline: str) -> None:
        for name in values.keys() - self._known:
            self._run.define_metric(name, step_metric=timeline)
            self._known.add(name)
        self._run.log(values)

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Write the distributions of the finite numbers, if there are any."""
        if self._run is None:
            return
        import wandb

        finite = {name: array[np.isfinite(array)] for name, array in values.items()}
        found = {
            name: wandb.Histogram(np_histogram=np.histogram(array, _BINS))
            for name, array in finite.items()
            if array.size
        }
        self._log({**found, timeline: step}, timeline)

    def note(self, text: str) -> None:
        """Add the text to the run's notes."""
        if self._run is not None:
            self._run.notes = "\n".join(filter(None, [self._run.notes, text]))

    def close(self) -> None:
        """Write the remaining numbers and finish the run."""
        if self._run is not None:
            self._write_waiting()
            self._folder = Path(self._run.dir).parent
            self._run.finish()
            self._run = None

    def outputs(self) -> Sequence[str]:
        """Return the folder of the run: see `Observer.outputs`."""
        if self._folder is None:
            return []
        if self._mode == "online":
            return [f"curves: {self._folder}"]
        return [f"curves: {self._folder}  (wandb sync {shlex.quote(str(self._folder))})"]
