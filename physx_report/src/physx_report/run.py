"""Run: a session, as the sections of its report read it."""

from __future__ import annotations

import contextlib
from functools import cached_property
from pathlib import Path
from typing import Any

from physx_core import Closeable, Dataset, Result, read_scalars
from physx_core.config import read_toml
from physx_core.errors import DatasetError, SessionError, found_at
from physx_core.pipelines import Unseen, open_unseen
from physx_core.results import read_results
from physx_report.film import Camera


class Run(Closeable):
    """A session, as the sections of its report read it; what is opened is closed with it.

    Attributes:
        path: The session's folder.
        results: Its results by the kind of pipeline: see `physx_core.Result`.
        trust: Whether to import whatever code its files name.
    """

    def __init__(self, path: str | Path, *, trust: bool = False) -> None:
        """Read the results.

        Args:
            path: The session's folder.
            trust: Whether to import whatever code its files name.

        Raises:
            SessionError: If it has none.
        """
        self.path, self.trust = Path(path), trust
        self.results: dict[str, Result] = read_results(self.path)
        if not self.results:
            raise SessionError(
                f"{self.path} has no result: name a session in which physx generate, train or "
                f"predict has run. {found_at(self.path)}"
            )
        self._opened = contextlib.ExitStack()

    @property
    def training(self) -> Result | None:
        """The result of its training, if there is one."""
        return self.results.get("training")

    @cached_property
    def config(self) -> dict[str, Any]:
        """The options that its pipelines were started with, by pipeline."""
        file = self.path / "config.toml"
        return read_toml(file) if file.is_file() else {}

    @cached_property
    def scalars(self) -> dict[tuple[str, str], dict[int, float]]:
        """The statistics of its training: see `physx_core.read_scalars`; empty without any."""
        try:
            return read_scalars(self.path)
        except SessionError:
            return {}

    @cached_property
    def dataset(self) -> Dataset | None:
        """Its own dataset; None without one."""
        with contextlib.suppress(DatasetError):
            return self._opened.enter_context(Dataset.open(self.path))
        return None

    @cached_property
    def unseen(self) -> Unseen | None:
        """Its last network, and the samples that this has not learned from; None without any.

        Raises:
            PhysxError: If they cannot be read.
        """
        if self.training is None or not self.training.parts:
            return None
        return self._opened.enter_context(open_unseen(self.path, trust=self.trust))

    @cached_property
    def camera(self) -> Camera:
        """Takes pictures of what environments draw.

        Raises:
            PhysxError: If no plugin can.
        """
        return self._opened.enter_context(Camera())

    def close(self) -> None:
        """Close what was opened; calling it again does nothing."""
        self._opened.close()
