"""Replay: stored samples go through the environment once more, without a network."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

from physx_core.config import DatasetConfig, EnvironmentConfig, at_least, from_plain, options
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError
from physx_core.pipelines.interrupt import deferred_interrupt
from physx_core.pipelines.pipeline import Pipeline, chosen_seed, stream_seed
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.typing import Batch

_RECORDED = ("environment", "env_kwargs", "num_clients", "simulations_per_step")


@options
@dataclass(eq=False)
class Replay(Pipeline):
    """Sends stored samples through the environments that made them, to look at in a visualizer.

    The samples of ``dataset_config.existing_dir``, mode ``dataset_config.mode``, come in the order
    of writing; the environments find them in `Environment.sample`, as in a `Prediction` with
    ``load_samples``. What `Environment.check_sample` says of them does not count, so that those of
    the mode "wrong" can be looked at too. The dataset is only read; the session keeps what the
    visualizer records.

    Attributes:
        source: The environments.
        batch: What they made of the present samples, one row for each instance.
        step_id: Number of steps that are finished.
    """

    dataset_config: DatasetConfig
    environment_config: EnvironmentConfig | None = None
    """None: the environment that the dataset says to have been made with."""
    session_dir: str = "sessions"
    """Folder of the sessions, relative to the working directory."""
    session_name: str = "replay"
    """Name of the session's folder."""
    new_session: bool = True
    """Leave an existing session of this name alone and number the new one; otherwise use it."""
    _: KW_ONLY
    step_nb: int | None = at_least(-1, None)
    """Number of steps, after the last sample comes the first; None: as many as it takes to see each
    sample once; -1: until Ctrl-C."""

    kind: ClassVar[str] = "replay"
    source: Source = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    step_id: int = field(init=False, repr=False, default=0)
    _stored: StoredRows = field(init=False, repr=False)

    def execute(self) -> None:
        """Replay. Ctrl-C ends the run in order after the present step.

        Raises:
            PhysxError: There are no such samples, or the environment failed.
        """
        with self._running(), deferred_interrupt() as interrupted:
            self.replay_begin()
            while self.replay_condition() and not interrupted():
                self.sample_begin()
                self.replay()
                self.sample_end()
            self.replay_end()

    def replay_begin(self) -> None:
        """The first step is about to be made."""
        self.step_id = 0
        steps = self._steps
        self.observers.begin("replay", None if steps < 0 else steps, "steps")

    def replay_condition(self) -> bool:
        """Return whether there are steps left."""
        return self._steps < 0 or self.step_id < self._steps

    def sample_begin(self) -> None:
        """A step is about to be made."""

    def replay(self) -> None:
        """Give each instance the next stored sample, and step it."""
        count = self.source.instance_nb
        self.batch = self.source.batch(count, self._stored.take_on(count))

    def sample_end(self) -> None:
        """Count the step."""
        self.step_id += 1
        self.observers.advance(1)

    def replay_end(self) -> None:
        """The last step is made."""
        self.observers.end()

    @property
    def _steps(self) -> int:
        if self.step_nb is None:
            return -(-self._stored.count // self.source.instance_nb)
        return self.step_nb

    def _open(self, resources: contextlib.ExitStack) -> None:
        config = self.dataset_config
        if config.existing_dir is None:
            raise ConfigError("Replay needs stored samples: name them in existing_dir.")
        dataset = resources.enter_context(Dataset.open(config.existing_dir))
        self._stored = StoredRows(dataset, config.mode)
        if self.environment_config is None:
            self.environment_config = from_plain(EnvironmentConfig, recorded_environment(dataset))
        environment = self.environment_config
        seed = chosen_seed(environment.seed)
        self.session = Session.create(self.session_dir, self.session_name, self.new_session)
        self._record_config(seed)
        self._observe(resources, environment)
        self.source = self._open_source(
            resources,
            environment,
            stream_seed(seed, "prediction", 0),
            in_process=environment.num_clients == 1,
            replayed=dataset.directory,
            accept_all=True,
        )


def recorded_environment(dataset: Dataset) -> dict[str, Any]:
    """Return what a dataset says of the environment that made it, as `EnvironmentConfig` takes it.

    Raises:
        ConfigError: It says nothing.
    """
    info: Mapping[str, Any] = dataset.info
    if not isinstance(info.get("environment"), str):
        raise ConfigError(
            f"The dataset in {dataset.directory} does not say which environment made it: name one."
        )
    return {name: info[name] for name in _RECORDED if name in info}
