"""Pipeline: the session, observers, and clean shutdown that all pipelines share."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from physx_core.cells import in_notebook
from physx_core.components.visualizer import Observer
from physx_core.config import EnvironmentConfig, to_plain
from physx_core.dataset.write.delegation import Delegation
from physx_core.errors import UsageError
from physx_core.observers import Observers, ProgressBar, ScalarsFile
from physx_core.pipelines.services import Predict, RunServices, Show, Touch
from physx_core.pipelines.storage import remove_unused
from physx_core.plugins import create
from physx_core.processes import (
    Terminated,
    describe_ending,
    is_ending,
    passes_through,
    raised_at_sigterm,
)
from physx_core.results import Result
from physx_core.results.stored import store_result
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.terminal import wrapped
from physx_core.workers.pasts import NOTHING, Skip

_STREAMS = {"training": 0, "validation": 1, "prediction": 2}


@dataclass(eq=False, kw_only=True)
class Pipeline(ABC):
    """Base class of the pipelines.

    A pipeline is a context manager: entering it opens its session, dataset, environments, and
    network, and leaving it always closes them. `execute` does both if the pipeline is not open.

    Subclasses may override two kinds of methods. The *events*, ``*_begin`` and ``*_end``, are empty
    and do not need `super`: a ``*_begin`` is called once the pipeline has prepared what begins, an
    ``*_end`` before it closes what ends. The *steps*, ``*_condition``, ``*_count`` and those named
    after what they do, do the work described in their docstrings; a replacement that leaves out
    what the run needs is an error. A loop of one's own over the steps of an open pipeline stores
    what `execute` does, but for its result.

    When it starts, a run prints to stderr where it writes; when it ends, what it stored and the
    next commands. A run that fails before it has stored anything removes the session created for
    it.

    Attributes:
        session: The run's folder; known once the pipeline is open.
        observers: Progress bar, statistics, and viewers.
        result: What the run found; known once `execute` has finished.
        kind: Name of the pipeline's table in configuration files.
    """

    session_dir: str = "sessions"
    """Folder of the sessions, relative to the working directory."""
    session_name: str = "training"
    """Name of the session's folder."""
    quiet: bool = field(default=False, metadata={"recorded": False})
    """Hide the progress bar and the messages about the session; warnings remain."""

    kind: ClassVar[str]
    session: Session = field(init=False, repr=False)
    observers: Observers = field(init=False, repr=False)
    result: Result = field(init=False, repr=False)
    _resources: contextlib.ExitStack | None = field(init=False, repr=False, default=None)
    _is_main = True  # whether this process writes the session; others only help with training
    _began = 0.0
    _has_finished = False

    if not TYPE_CHECKING:  # type checkers would accept every misspelled attribute

        def __getattr__(self, name: str) -> object:
            """Explain why an attribute of a running pipeline does not exist yet."""
            what = f"{type(self).__name__!r} object has no attribute {name!r}"
            if name in {each.name for each in fields(self) if not each.init}:
                what += " yet: it is known once the pipeline runs; call execute() first"
            raise AttributeError(what, name=name, obj=self)

    @abstractmethod
    def execute(self) -> Result:
        """Run the pipeline from start to end, and return what it found."""

    @abstractmethod
    def _open(self, resources: contextlib.ExitStack) -> None:
        """Open everything, and push what must be closed onto the stack."""

    @abstractmethod
    def _begin(self) -> None:
        """Return to the first step: when the pipeline opens, and when `execute` begins."""

    def _plan(self) -> Iterable[str]:
        """Return lines on what the run, now open, is about to do."""
        return ()

    def _results(self, error: BaseException | None) -> Iterable[str]:
        """Return lines on what the run did and stored.

        Args:
            error: What ended the run; None: it finished.
        """
        return ()

    def _findings(self) -> dict[str, Any]:
        """Return what `Result` says of the finished run besides the lines of `_results`."""
        return {}

    def _next(self, error: BaseException | None) -> Iterable[str]:
        """Return commands that continue from here.

        Args:
            error: What ended the run; None: it finished.
        """
        return ()

    def _components(self) -> Mapping[str, str]:
        """Return descriptions of the run's components by name, for ``info.txt``."""
        return {}

    def __enter__(self) -> Self:
        """Open the session and everything that the pipeline works with.

        Raises:
            UsageError: If a client runs a script without ``if __name__ == "__main__":``.
            PhysxError: If something that the pipeline needs is missing or fails.
        """
        if os.environ.get("PHYSX_CLIENT"):
            raise UsageError(
                "A client imported the script that defines its environment, and the script started "
                'a pipeline. Put the pipeline under  if __name__ == "__main__":'
            )
        self.session = None  # type: ignore[assignment]
        try:
            with contextlib.ExitStack() as resources:
                self._began, self._has_finished = time.monotonic(), False
                resources.enter_context(raised_at_sigterm())
                self._open(resources)
                self._begin()
                self._describe_components()
                self._resources = resources.pop_all()
        except BaseException as error:
            if self.session is not None:
                remove_unused(self.session, opened=False)
            judged = _judge(error, error.__traceback__)
            if judged is error:
                raise
            raise judged from error
        announcements = (*self._plan(), *self.observers.announcements())
        self._say(f"session: {self.session.path}{self._why_here()}", *announcements)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close everything."""
        resources, self._resources = self._resources, None
        if resources is None:
            return
        judged = None if error is None else _judge(error, trace)
        self._note_end(judged)
        try:
            resources.__exit__(None if judged is None else type(judged), judged, trace)
        except BaseException as closing:
            judged = _judge(closing, closing.__traceback__)
            if judged is closing:
                raise
            error = closing
        finally:
            self._end(judged)
        if judged is not None and judged is not error:
            raise judged from error

    def _end(self, error: BaseException | None) -> None:
        """Report what the run stored, or remove its session if that is nothing."""
        outputs = self.observers.outputs()
        if error is not None and not outputs and remove_unused(self.session, opened=True):
            self._say(f"session: {self.session.path} was removed: the run stored nothing in it")
            return
        written = [line.removesuffix(")").partition("  (") for line in outputs]
        shows = (command for _, _, command in written if command)
        commands = (f"next: {command}" for command in (*shows, *self._next(error)))
        if error is None and self._has_finished:
            self._conclude()
            lines: Iterable[str] = self.result.lines
        else:
            lines = self._results(error)
        self._say(*lines, *(file for file, _, _ in written), *commands)

    def _conclude(self) -> None:
        """Make the result of the finished run, and store it in the session."""
        path, found = str(self.session.path), self._findings()
        places = {"session": path, **found.pop("places", {})}
        summary = tuple(self._results(None))
        self.result = Result(self.kind, path, self._duration, summary, places=places, **found)
        if self._is_main:
            store_result(self.session.path, self.result)

    def _say(self, *lines: str) -> None:
        """Print lines, in the process that writes the session.

        They go to stderr, in a notebook to stdout, as it shows stderr as if all of it were errors.
        """
        stream = sys.stdout if in_notebook() else sys.stderr
        if self._is_main and not self.quiet and stream is not None:
            with contextlib.suppress(OSError, ValueError):  # a closed stream must not end a run
                stream.write("".join(f"{wrapped(line)}\n" for line in lines))
                stream.flush()

    def _describe_components(self) -> None:
        components = self._components()
        if self._is_main and components:
            texts = (f"{name}: {text}" for name, text in components.items())
            self.session.note("\n".join(text.replace("\n", "\n  ") for text in texts))

    @property
    def _duration(self) -> float:
        """Time in s since the pipeline started to open."""
        return time.monotonic() - self._began

    def _note_end(self, error: BaseException | None) -> None:
        how = "finished"
        if isinstance(error, (KeyboardInterrupt, Terminated)):
            how = "interrupted"
        elif error is not None:
            how = f"ended by {type(error).__name__}"
        if self._is_main:
            with contextlib.suppress(OSError):  # the run's own error matters more
                self.session.note(f"{how} after {self._duration:.1f} s")

    def _count(self, counter: str, method: str) -> None:
        """Call the counting method; a replacement that does not count makes the run endless."""
        before = getattr(self, counter)
        getattr(self, method)()
        if getattr(self, counter) == before:
            raise self._lacks(method, f"did not advance {counter}", f"increase self.{counter}")

    def _is_own(self, step: Callable[..., None]) -> bool:
        """Return whether a step is physx's own method, which needs no checks, or is replaced."""
        return getattr(getattr(self, step.__name__), "__func__", None) is step

    def _check_condition(self, answer: bool | None, method: str) -> None:
        """Check the answer with which a condition ended a loop: one without ``return`` is None."""
        if answer is None:
            raise self._lacks(method, "returned None", "return whether the run goes on")

    def _lacks(self, method: str, what: str, remedy: str) -> UsageError:
        """Return the error of a replaced step that leaves out what the run needs."""
        return UsageError(
            f"{type(self).__name__}.{method}() {what}: call super().{method}(), or {remedy}."
        )

    @contextlib.contextmanager
    def _running(self) -> Iterator[None]:
        """Open the pipeline for the duration of a run, unless the user has opened it."""
        with contextlib.ExitStack() as opened:
            closes = self._resources is None
            if closes:
                opened.enter_context(self)
            else:
                self._begin()
            yield
            self.observers.end()
            self._has_finished = True
            if not closes:
                self._conclude()

    def _observe(
        self,
        resources: contextlib.ExitStack,
        environment: EnvironmentConfig | None,
        further: Iterable[Observer] = (),
    ) -> None:
        """Open the run's observers, only in the process that writes the session."""
        if not self._is_main:
            self.observers = Observers([])
            return
        bars = [] if self.quiet else [ProgressBar()]
        observers: list[Observer] = [*bars, ScalarsFile(), *further]
        instance_nb = 0
        if environment is not None:
            instance_nb = environment.num_clients
            if environment.visualizer is not None:
                observers.append(
                    create("visualizer", environment.visualizer, environment.visualizer_kwargs)
                )
        self.observers = Observers(observers)
        self.observers.open(self.session.name, self.session.path, instance_nb)
        resources.callback(self.observers.close)

    def _why_here(self) -> str:
        """Return why the run writes to this session, if that is not obvious."""
        if not self.session.is_new:
            return " (continued)"
        taken = self.session.name != self.session_name
        return f' ("{self.session_name}" exists)' if taken else ""

    def _open_source(
        self,
        resources: contextlib.ExitStack,
        config: EnvironmentConfig,
        seed: Sequence[int],
        *,
        predict: Predict | None = None,
        show: Show | None = None,
        run_ahead: int | None = None,
        total: int | None = None,
        in_process: bool = False,
        replayed: Path | None = None,
        accept_all: bool = False,
        skip: Skip = NOTHING,
        delegation: Delegation | None = None,
        keeps_pasts: bool = False,
        touch: Touch | None = None,
    ) -> Source:
        """Open the environments, in this process or in clients.

        Args:
            resources: Closes them at the end.
            config: The environment, and how its instances run.
            seed: Seed of the instances.
            predict: The network's prediction for a batch; None: there is no network.
            show: Receives drawing events; None: the observers.
            run_ahead: Number of rows that clients may generate before they are requested; None: as
                many as `ClientSource` permits. `ClientSource` describes when it must be 0.
            total: Number of rows that will be requested; None: unknown.
            in_process: Whether they must run in this process.
            replayed: Folder of the dataset whose samples they replay; the parameters saved there
                can be loaded. None: they generate new samples.
            accept_all: Whether to accept samples that `check_sample` rejects.
            skip: The rows that an earlier run already had: they are generated again, but not
                returned.
            delegation: Lets clients write their own rows; None: the source returns them.
            keeps_pasts: Whether the run keeps what a later one needs to go on from states.
            touch: What a person does to an instance; None: what the observers say.
        """
        self._tell_repeated(config, skip)
        shown, touched = show or self.observers.events, touch or self.observers.touch
        services = RunServices(self.session.dataset_dir, shown, predict, replayed, touched)
        source: Source
        if in_process or not config.as_tcp_ip_client:
            from physx_core.sources.local_source import LocalSource

            source = LocalSource(
                config, services, seed, accept_all=accept_all, skip=skip, keeps_pasts=keeps_pasts
            )
        else:
            from physx_core.sources.client_source import ClientSource

            source = ClientSource(
                config,
                services,
                seed,
                run_ahead=run_ahead,
                total=total,
                accept_all=accept_all,
                skip=skip,
                delegation=delegation,
                keeps_pasts=keeps_pasts,
            )
        return resources.enter_context(source)

    def _tell_repeated(self, config: EnvironmentConfig, skip: Skip) -> None:
        """Say that a run repeats rows of an earlier one, if it does not go on from states."""
        repeated = skip.repeated(config.num_clients)
        if repeated and not skip.pasts:
            said = f"{repeated:,} samples are stored, and simulated again first"
            if not config.state_every:
                said += "; with state_every (--environment.state-every) it would go on from states"
            self._say(said)

    def _record_config(self, seed: int, **others: object) -> None:
        """Write the options, some of them changed, and the actual seed to the session."""
        if not self._is_main:
            return
        plain = {**to_plain(self), **others, "session_name": self.session.name}
        plain = {name.removesuffix("_config"): value for name, value in plain.items()}
        (plain if hasattr(self, "seed") else plain["environment"])["seed"] = seed
        self.session.record(self.kind, plain, seed)


@dataclass(eq=False, kw_only=True)
class NewSessionPipeline(Pipeline):
    """Base class of the pipelines that may create their session."""

    new_session: bool = True
    """If a session of this name exists, create a new one with a number; otherwise continue in the
    existing one."""

    def _create_session(self) -> Session:
        return Session.create(self.session_dir, self.session_name, self.new_session)


def _judge(error: BaseException, trace: TracebackType | None) -> BaseException:
    """Return the error of a run that ended: user code that exits does not finish it.

    What the user's own ``with`` block raises is returned as it is.
    """
    if not is_ending(error) or not passes_through(trace, "physx_core"):
        return error
    return UsageError(
        f"{describe_ending(error)}, but the run is not finished. To end it early, let a condition "
        "return False; after a failure, raise an error."
    )


def choose_seed(seed: int | None) -> int:
    """Return the seed, or a random one if it is None."""
    if seed is not None:
        return seed
    return int(np.random.SeedSequence().generate_state(1, np.uint32)[0])


def derive_seed(seed: int, mode: str, offset: int) -> list[int]:
    """Return the seed of a run's environments.

    Args:
        seed: The configured seed.
        mode: Mode of the samples, so that different modes get different samples.
        offset: Number of samples already in the mode, or of campaigns, so that a run does not
            generate them again.
    """
    return [seed, _STREAMS[mode], offset]
