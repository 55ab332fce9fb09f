"""Branch: goes back to a stored row, and on from there twice: as it was, and with a change."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from physx_core import plugins
from physx_core.components.scene.event import Event
from physx_core.config import EnvironmentConfig, at_least, from_plain, options, to_plain
from physx_core.dataset import Dataset
from physx_core.errors import UsageError
from physx_core.pipelines.data_generation import DataGeneration
from physx_core.pipelines.learning.learner import Learner
from physx_core.pipelines.learning.loading import load_learner
from physx_core.pipelines.pipeline import NewSessionPipeline
from physx_core.pipelines.redrawing import Redrawing
from physx_core.pipelines.replay import recorded_environment
from physx_core.plugins.hookspecs import LOG
from physx_core.processes import Interrupt, TemporaryFolder, deferred_interrupt
from physx_core.results import Result
from physx_core.results.wording import number, plain
from physx_core.typing import Array, Batch, Sample
from physx_core.workers.instance import Instance

AS_IT_WAS, CHANGED = 1, 2
"""Numbers of the instances that are drawn."""


@options
@dataclass(eq=False)
class Branch(NewSessionPipeline):
    """Goes back to a stored row, and on from there twice: as it was, and with a change.

    In this process, the environment simulates the row's episode again, or its stream from the last
    state that is stored before it, and each row is compared with the stored one, bit by bit. From
    there, it goes on as it did, and is compared as far as rows are stored. A second instance does
    the same, is changed at the row, and goes on. Both are drawn, and the dataset is only read.

    Attributes:
        futures: What the instances did after the row, by field, arrays of shape (rows, ...).
        rows_equal: Number of rows that are equal to the stored ones: to the row, and after it.
        differences: Root mean square difference of the futures in each row that both have, by
            field of floats, shape (rows,).
    """

    data: str | Path
    """Folder of the session or dataset; or the log of an episode, which is simulated again."""
    row: int = at_least(0)
    """Number of the row in its mode."""
    change: dict[str, Any] = field(default_factory=dict)
    """What is different in the second future: see `Environment.perturb`."""
    policy: str | Path | None = None
    """Session whose network acts or predicts in the second future."""
    _: KW_ONLY
    session_name: str = "branch"
    """Name of the new session."""
    mode: str = "training"
    """Mode of the row."""
    step_nb: int = at_least(1, 100)
    """Number of rows after it."""
    past: int = at_least(1, 100)
    """Number of rows up to it that are drawn."""
    visualizer: str | None = None
    """What draws; None: nothing."""
    visualizer_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of the visualizer."""
    trust: bool = field(default=False, metadata={"recorded": False})
    """Import whatever code the dataset and the policy's session name."""

    kind: ClassVar[str] = "branch"
    futures: tuple[Batch, Batch] = field(init=False, repr=False)
    rows_equal: tuple[int, int] = field(init=False, repr=False, default=(0, 0))
    differences: dict[str, Array] = field(init=False, repr=False)
    _dataset: Dataset = field(init=False, repr=False)
    _learner: Learner | None = field(init=False, repr=False, default=None)
    _answers: int = field(init=False, repr=False, default=0)

    def execute(self) -> Result:
        """Simulate the past and both futures.

        Raises:
            PhysxError: If there is no such row, or the environment makes other rows, cannot be
                changed so, or fails.
            KeyboardInterrupt: After Ctrl-C before the second future begins.
            SystemExit: After SIGTERM, with status 143.
        """
        with self._running(), deferred_interrupt() as interrupt:
            self.observers.begin("branch", 2 * self.step_nb, "steps")
            futures = []
            for number in (AS_IT_WAS, CHANGED):
                with self._redrawing(number) as drawing:
                    futures.append(_stacked(self._samples(drawing, number, interrupt)))
                if interrupt and (number == AS_IT_WAS or interrupt.number == signal.SIGTERM):
                    interrupt.end()
            self.futures = futures[0], futures[1]
            self._check_futures()
            self.differences = _differences(*self.futures)
        return self.result

    def _redrawing(self, number: int) -> Redrawing:
        predict = self._predict if number == CHANGED and self._learner is not None else None
        return Redrawing(self._dataset, self.mode, trust=self.trust, predict=predict, patience=None)

    def _samples(self, drawing: Redrawing, number: int, interrupt: Interrupt) -> Iterator[Sample]:
        """Simulate the past and a future of an instance; yield the samples of the future."""
        before, after = drawing.around(self.row)
        shown = drawing.shown(before, self.past)
        for step, events in enumerate(drawing.frames(shown)):
            self._show(number, step, events)
            if interrupt:
                interrupt.end()
        if number == CHANGED:
            self._change(drawing.instance)
        equal = 0
        for index, (sample, events) in enumerate(drawing.go_on(self.step_nb)):
            if number == CHANGED:
                self._apply(drawing.instance, sample)
            elif index < len(after):
                drawing.compare(after[index], sample)
                equal += 1
            self._show(number, len(shown) + index, events)
            self.observers.advance(1)
            yield sample
            if interrupt:
                break
        if number == AS_IT_WAS:
            self.rows_equal = drawing.compared, equal

    def _change(self, instance: Instance) -> None:
        environment = instance.environment
        assert environment is not None
        acts = self._learner is not None and hasattr(environment, "policy")
        environment.perturb(**({"policy": "network"} if acts else {}), **self.change)

    def _apply(self, instance: Instance, sample: Sample) -> None:
        """Give an environment the network's prediction, if it takes any."""
        learner = self._learner
        if learner is None or instance.ignores_predictions:
            return
        given = {name: np.asarray(sample[name])[np.newaxis] for name in learner.network.net_fields}
        instance.apply({name: values[0] for name, values in self._predict(given).items()})

    def _predict(self, batch: Batch) -> Batch:
        assert self._learner is not None
        self._answers += 1
        return self._learner.predict(batch)

    def _check_futures(self) -> None:
        if not self.futures[0]:
            raise UsageError(
                f"The episode of row {self.row:,} ends with it: branch off an earlier row."
            )
        if self._learner is not None and not self._answers:
            raise UsageError(
                f"The network of {self.policy} was never asked: the environment neither calls "
                "get_prediction() nor defines apply_prediction(), and has no policy."
            )

    def _show(self, number: int, step: int, events: list[Event]) -> None:
        if step == 0:
            title = "as it was" if number == AS_IT_WAS else self._difference
            events = list(_titled(events, title))
        if events:
            self.observers.events(number, step, events)

    @property
    def _difference(self) -> str:
        """What is different in the second future, in words."""
        told = [f"{name} = {plain(value)}" for name, value in self.change.items()]
        told += [] if self.policy is None else [f"the network of {self.policy}"]
        return f"with {', '.join(told)}"

    def _begin(self) -> None:
        self._answers = 0

    def _open(self, resources: contextlib.ExitStack) -> None:
        if not self.change and self.policy is None:
            raise UsageError("Nothing changes: give change (--set NAME=VALUE ...) or a policy.")
        is_log = Path(self.data).is_file()
        data = self._simulate_log(resources) if is_log else self.data
        dataset = self._dataset = resources.enter_context(Dataset.open(data))
        if self.policy is not None:
            self._learner = load_learner(self.policy, trust=self.trust)
        with self._redrawing(AS_IT_WAS) as drawing:
            drawing.around(self.row)  # before there is a session
        self.session = self._create_session()
        self.session.record(self.kind, to_plain(self), 0)
        recorded = recorded_environment(dataset, trust=self.trust)
        known = from_plain(EnvironmentConfig, recorded)
        drawn = replace(
            known,
            num_clients=2,
            visualizer=self.visualizer,
            visualizer_kwargs=self.visualizer_kwargs,
        )
        self._observe(resources, drawn)

    def _simulate_log(self, resources: contextlib.ExitStack) -> Path:
        """Simulate the episode in a log again; return the folder of its rows, a temporary one."""
        if LOG not in plugins.references_of("environment"):
            raise UsageError(
                f"{self.data} is a file, and no installed plugin simulates episodes in logs again: "
                "give the folder of a session or dataset."
            )
        environment = EnvironmentConfig(
            plugins.complete_reference("environment", LOG),
            {"path": str(self.data)},
            as_tcp_ip_client=False,
            seed=0,
        )
        folder = str(resources.enter_context(TemporaryFolder("physx_branch_")).path)
        again = DataGeneration(environment, episodes=1, session_dir=folder, quiet=True)
        return Path(again.execute().places["session"])

    def _results(self, error: BaseException | None) -> Iterable[str]:
        if error is not None:
            return
        past, future = self.rows_equal
        was, changed = (len(next(iter(each.values()), ())) for each in self.futures)
        yield f"row {self.row:,} of {self.mode}, simulated again: {past:,} rows equal those stored"
        yield f"as it was: {was:,} rows, of which {future:,} are stored and equal"
        yield f"{self._difference}: {changed:,} rows"
        for name, values in self.differences.items():
            shown = sorted({0, len(values) // 4, len(values) - 1})
            each = ", ".join(f"{number(values[k])} after {k + 1:,}" for k in shown)
            yield f"  {name}: root mean square difference {each} rows"

    def _findings(self) -> dict[str, Any]:
        found = self.differences.items()
        return {"numbers": {f"difference/{name}/rmse": float(values[-1]) for name, values in found}}


def _differences(was: Batch, changed: Batch) -> dict[str, Array]:
    """Return by how much futures differ in each row that both have, by field."""
    found = {}
    for name, values in was.items():
        other = changed.get(name, values[:0])
        count = min(len(values), len(other))
        if count and values.dtype.kind == "f" and values.shape[1:] == other.shape[1:]:
            square = np.square(values[:count] - other[:count], dtype=np.float64)
            found[name] = np.sqrt(square.reshape(count, -1).mean(axis=1))
    return found


def _titled(events: Sequence[Event], title: str) -> Iterator[Event]:
    """Yield the first events of an instance, with the title of its window."""
    has_view = False
    for event in events:
        is_view = event.kind == "view"
        has_view |= is_view
        yield replace(event, values={**event.values, "title": title}) if is_view else event
    if not has_view:
        yield Event("add", "view", ("view",), {"title": title, "follow": None})


def _stacked(rows: Iterable[Sample]) -> dict[str, Array]:
    """Return samples as arrays of shape (rows, ...), of the fields that have equal shapes."""
    found: dict[str, Array] = {}
    samples = list(rows)
    for name in samples[0] if samples else ():
        values = [np.asarray(each[name]) for each in samples]
        if len({each.shape for each in values}) == 1:
            found[name] = np.stack(values)
    return found
