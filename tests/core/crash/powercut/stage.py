"""The stage of a history: one process without threads, whose operations are recorded."""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any
from unittest import mock

import physx_core.checkpoint
import physx_core.dataset.write.writer as writer_module
from physx_core import files
from physx_core.dataset.store import syncing
from physx_core.dataset.store.partition import file as partition_file
from physx_core.dataset.store.partition import format as partition_format
from powercut.disk import Recorder


class Later(Future[Any]):
    """Work that is done when it is waited for, or before."""

    def __init__(self, work: Callable[[], Any]) -> None:
        super().__init__()
        self._work: Callable[[], Any] | None = work

    def do(self) -> None:
        """Do the work, if it was not done yet."""
        work, self._work = self._work, None
        if work is not None:
            try:
                self.set_result(work())
            except Exception as error:
                self.set_exception(error)

    def result(self, timeout: float | None = None) -> Any:
        """Return the result of the work."""
        self.do()
        return super().result(timeout)


class Executor:
    """Stands in for a writer's background thread: its work waits until `Stage.work`."""

    def __init__(self, *_: object) -> None:
        self.waiting: list[Later] = []
        self.actor = Stage.now.actor
        Stage.now.executors.append(self)

    def submit(self, function: Callable[..., Any], *given: Any) -> Later:
        """Note some work."""
        later = Later(lambda: function(*given))
        self.waiting.append(later)
        return later

    def shutdown(self, **_: object) -> None:
        """Do what is left."""
        while self.work():
            pass

    def work(self) -> bool:
        """Do the first piece of work that waits; return whether there was one."""
        while self.waiting:
            later = self.waiting.pop(0)
            if not later.done():
                later.do()
                return True
        return False


class Syncer(syncing.Syncer):
    """A syncer without a thread: it syncs when it is told to."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._thread = _NoThread()  # type: ignore[assignment]
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


class _NoThread:
    def join(self, *_: object) -> None:
        """Be at an end."""

    def is_alive(self) -> bool:
        """Be at work."""
        return True


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
        self.executors: list[Executor] = []
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
            stack.enter_context(patch(writer_module, "ThreadPoolExecutor", Executor))
            stack.enter_context(patch(writer_module, "Syncer", Syncer))
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
