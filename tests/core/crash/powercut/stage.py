"""The stage of a history: one process without threads, whose operations are recorded."""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import physx_core.checkpoint
import physx_core.dataset.write.partition_writer as partition_writer_module
import physx_core.dataset.write.writer as writer_module
from physx_core import files
from physx_core.dataset.store import syncing
from physx_core.dataset.store.partition import file as partition_file
from physx_core.dataset.store.partition import format as partition_format
from physx_core.dataset.write import opening
from physx_core.dataset.write.writer import Writer
from physx_core.processes import Helper
from powercut.disk import Recorder


class LaterHelper(Helper[Any]):
    """A helper without a thread: a job waits until it is told to work, or its result is taken."""

    def __init__(self, name: str) -> None:
        super().__init__(name, inline=True)
        self.waiting: list[Callable[[], Any]] = []
        self.actor = Stage.now.actor
        if name == "physx-seal":
            Stage.now.executors.append(self)

    def give(self, job: Callable[[], Any]) -> None:
        """Note a job."""
        self.waiting.append(job)
        self.pending += 1

    def take(self) -> Any:
        """Return the result of the next job."""
        if not self.is_ready:
            self.work()
        return super().take()

    def close(self) -> None:
        """Do what is left."""
        while self.work():
            pass

    def work(self) -> bool:
        """Do the first job that waits; return whether there was one."""
        if not self.waiting:
            return False
        super().give(self.waiting.pop(0))
        self.pending -= 1  # it was counted when it was given
        return True


class Syncer(syncing.Syncer):
    """A syncer that syncs when it is told to."""

    def __init__(self, helper: Helper[Any]) -> None:
        super().__init__(helper)
        self.actor = Stage.now.actor
        self._at_work = False
        Stage.now.syncers.append(self)

    @property
    def busy(self) -> bool:
        """Whether it is at work, or the writer holds a lock that it would wait for."""
        noted = (file for part in self._partitions for file in part.files.values())
        return self._at_work or any(part._lock.locked() for part in (self, *noted))

    def sync(self) -> None:
        """Sync what is scheduled."""
        self._at_work = True
        try:
            super().sync()
        finally:
            self._at_work = False


class Stage:
    """What is at work on the stage.

    Attributes:
        now: The present stage.
        boot: What tells this run of the machine from others.
        actor: The writer at work.
        executors: The writers' background threads.
        syncers: The writers' syncers.
    """

    now: Stage

    def __init__(self) -> None:
        self.boot = "boot 0"
        self.actor = 0
        self.executors: list[LaterHelper] = []
        self.syncers: list[Syncer] = []

    def bury(self, actor: int | None = None) -> None:
        """Forget the background of a dead writer, or of all."""
        self.executors = [e for e in self.executors if actor not in (None, e.actor)]
        self.syncers = [s for s in self.syncers if actor not in (None, s.actor)]

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Let datasets and checkpoints run on this stage."""
        before = getattr(Stage, "now", None)
        Stage.now = self
        with contextlib.ExitStack() as stack:
            patch = mock.patch.object
            writer = functools.partial(Writer, helper=LaterHelper)
            stack.enter_context(patch(opening, "Writer", writer))
            for module in (writer_module, partition_writer_module):
                stack.enter_context(patch(module, "Syncer", Syncer))
            stack.enter_context(patch(partition_format, "boot_id", lambda: Stage.now.boot))
            stack.enter_context(patch(partition_file, "make_header", _make_header))
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
            try:
                yield
            finally:
                Stage.now = before  # type: ignore[assignment]

    @contextlib.contextmanager
    def recorded(self, recorder: Recorder) -> Iterator[None]:
        """Have what is done noted by a recorder."""
        before = [(module, module.os) for module in _modules()]
        for module, _ in before:
            module.os = recorder
        try:
            yield
        finally:
            for module, former in before:
                module.os = former


_make = partition_format.make_header


def _make_header(*given: Any) -> Any:
    """Return what HDF5 makes, which takes long, once for all files that are alike."""
    return _made(Stage.now.boot, *given)


@functools.lru_cache(500)
def _made(_: str, *given: Any) -> Any:
    return _make(*given)


def _modules() -> list[Any]:
    """Return the modules that may change files."""
    prefixes = (files.__name__, "physx_core.dataset.", physx_core.checkpoint.__name__)
    return [
        module
        for name, module in sys.modules.items()
        if name.startswith(prefixes) and hasattr(module, "os")
    ]
