"""Replay: sends stored samples through their environment again, without a network."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

from physx_core.config import EnvironmentConfig, at_least, from_plain, options, to_plain
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, UntrustedReferenceError
from physx_core.pipelines.pipeline import NewSessionPipeline, choose_seed, derive_seed
from physx_core.pipelines.storage import reject_client_writers
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.plugins.references import check_recorded, find, is_recorded_as
from physx_core.processes import deferred_interrupt
from physx_core.results import Result
from physx_core.sources.source import Source
from physx_core.typing import Batch
from physx_core.views.dataset_config import DatasetConfig

_RECORDED = (
    *("environment", "env_kwargs", "num_clients"),
    *("independent_episodes", "episode_steps", "simulations_per_step"),
)
_MOST_CLIENTS = 64


@options
@dataclass(eq=False)
class Replay(NewSessionPipeline):
    """Sends stored samples through the environments that generated them, to view them.

    The samples of mode ``dataset_config.mode`` in ``dataset_config.existing_dir`` come in the order
    of writing and are available as `Environment.sample`, as in a `Prediction` with
    ``load_samples``. The result of `Environment.check_sample` is ignored, so the samples of the
    mode "wrong" can be viewed too. The dataset is only read; the session stores what the visualizer
    records.

    Attributes:
        source: The environments.
        batch: The samples that the environments generated from the current ones, one row each.
        step_id: Number of finished steps.
    """

    dataset_config: DatasetConfig
    """The stored samples: ``existing_dir`` is required."""
    environment_config: EnvironmentConfig | None = None
    """The environment; None: the one that the dataset was generated with."""
    _: KW_ONLY
    session_name: str = "replay"
    """Name of the new session."""
    step_nb: int | None = at_least(-1, None)
    """Number of steps, starting over after the last sample; None: show each sample once; -1: until
    Ctrl-C."""
    trust: bool = field(default=False, metadata={"recorded": False})
    """Import whatever code the dataset names as its environment, not only components of installed
    plugins."""

    kind: ClassVar[str] = "replay"
    source: Source = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    step_id: int = field(init=False, repr=False, default=0)
    _stored: StoredRows = field(init=False, repr=False)

    def execute(self) -> Result:
        """Replay the samples. Ctrl-C and SIGTERM end the run cleanly after the current step.

        Raises:
            PhysxError: If there are no such samples, or the environment fails.
            SystemExit: After SIGTERM, with status 143; a second signal ends the run immediately.
        """
        with self._running(), deferred_interrupt() as interrupt:
            steps = self._steps
            self.observers.begin("replay", None if steps < 0 else steps, "steps")
            self.replay_begin()
            own = self._is_own(Replay.replay)
            while (more := self.replay_condition()) and not interrupt:
                self.sample_begin()
                if own:
                    self.replay()
                else:
                    self._check_replay()
                self.sample_end()
            self._check_condition(more, "replay_condition")
            self.replay_end()
            if interrupt.number == signal.SIGTERM:
                interrupt.end()
        return self.result

    def replay_begin(self) -> None:
        """Called before the first step."""

    def replay_condition(self) -> bool:
        """Return whether there are steps left."""
        return self._steps < 0 or self.step_id < self._steps

    def sample_begin(self) -> None:
        """Called before each step."""

    def replay(self) -> None:
        """Give each instance the next stored sample, and step it; then count the step."""
        count = self.source.instance_nb
        self.batch = self.source.batch(count, self._stored.take_cyclic(count))
        self._count_step()

    def _count_step(self) -> None:
        self.step_id += 1
        self.observers.advance(1)

    def _check_replay(self) -> None:
        """Call a replacement of `replay`, which need not count the step."""
        begins, earlier = self.step_id, self.batch
        self.replay()
        if self.batch is earlier:
            raise self._lacks("replay", "set no batch", "set self.batch = self.source.batch(...)")
        if self.step_id == begins:
            self._count_step()

    def sample_end(self) -> None:
        """Called after each step."""

    def replay_end(self) -> None:
        """Called after the last step."""

    @property
    def _steps(self) -> int:
        if self.step_nb is None:
            return -(-self._stored.count // self.source.instance_nb)
        return self.step_nb

    def _begin(self) -> None:
        self.step_id, self.batch = 0, {}

    def _open(self, resources: contextlib.ExitStack) -> None:
        config = self.dataset_config
        reject_client_writers(config, "a replay")
        if config.existing_dir is None:
            raise ConfigError("Replay needs stored samples: name their dataset in existing_dir.")
        dataset = resources.enter_context(Dataset.open(config.existing_dir))
        self._stored = StoredRows(dataset, config.mode)
        if self.environment_config is None:
            self.environment_config = from_plain(
                EnvironmentConfig, recorded_environment(dataset, trust=self.trust)
            )
        environment = self.environment_config
        seed = choose_seed(environment.seed)
        self.session = self._create_session()
        self._record_config(seed)
        self._observe(resources, environment)
        self.source = self._open_source(
            resources,
            environment,
            derive_seed(seed, "prediction", 0),
            run_ahead=0,
            in_process=environment.num_clients == 1,
            replayed=dataset.directory,
            accept_all=True,
        )

    def _results(self, error: BaseException | None) -> Iterable[str]:
        environment = self.environment_config
        yield f"{self.step_id} steps of {to_plain(environment)['environment']}"


def recorded_environment(
    dataset: Dataset,
    given: Any = None,
    *,
    trust: bool = False,
    info: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the options of the environment that a dataset was generated with.

    Args:
        dataset: The dataset, which is not trusted.
        given: The environment that the user named; None: the dataset's. If it is a different one,
            the dataset's options do not apply.
        trust: Whether the dataset may name any class.
        info: Describes the environment; None: the dataset's info, which describes the last one.

    Raises:
        ConfigError: If the dataset does not name its environment.
        UntrustedReferenceError: If it names code that is not a component of an installed plugin, or
            a program.
    """
    info = dataset.info if info is None else info
    recorded = info.get("environment")
    if given is not None and not is_recorded_as(given, recorded):
        return {}
    if not isinstance(recorded, str):
        raise ConfigError(
            f"The dataset in {dataset.directory} does not name its environment: name one."
        )
    check_recorded(
        "environment",
        dataset.directory / "dataset.json",
        recorded if given is None else None,
        info.get("env_kwargs"),
        f"physx replay {dataset.directory} REFERENCE (in Python EnvironmentConfig(...)) and its "
        "arguments",
        trust=trust,
    )
    component = find("environment", recorded if given is None else given)
    if not trust and getattr(component, "runs_programs", False):
        raise UntrustedReferenceError(
            f"The dataset in {dataset.directory} contains arguments for {recorded}, which runs the "
            "programs that they name. Give the arguments yourself, or trust the dataset: --trust "
            "(in Python trust=True)."
        )
    count = info.get("num_clients", 1)
    if not trust and isinstance(count, int) and count > _MOST_CLIENTS:
        raise ConfigError(
            f"{dataset.directory} asks for {count} processes. If this is intended, use --trust (in "
            "Python trust=True); otherwise give the environment's options yourself."
        )
    return {name: info[name] for name in _RECORDED if name in info}
