"""Prediction: a trained network takes part in the running simulation."""

from __future__ import annotations

import contextlib
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import ClassVar

from physx_core import checkpoint
from physx_core.config import DatasetConfig, EnvironmentConfig, NetworkConfig, at_least, options
from physx_core.dataset import Dataset
from physx_core.fields import Batch, Field
from physx_core.pipelines.learner import Learner, restored
from physx_core.pipelines.pipeline import Pipeline, chosen_seed, stream_seed
from physx_core.pipelines.storage import describe_environment, open_own
from physx_core.session import Session
from physx_core.sources.source import Source


@options
@dataclass(eq=False)
class Prediction(Pipeline):
    """Steps the environment and gives it the network's prediction, again and again.

    The environment runs in this process, whatever ``as_tcp_ip_client`` says.

    Attributes:
        learner: The network and its transformation, from the session's checkpoint.
        source: The environment.
        dataset: The session's own dataset, open for writing, if samples are recorded; else None.
        batch: The present samples, one row for each instance of the environment.
        prediction: The network's prediction for them, in physical units.
        step_id: Number of steps that are finished.
    """

    network_config: NetworkConfig
    environment_config: EnvironmentConfig
    dataset_config: DatasetConfig | None = None
    session_dir: str = "sessions"
    """Folder of the sessions, relative to the working directory."""
    session_name: str = "training"
    """Name of the session whose network predicts."""
    _: KW_ONLY
    step_nb: int = at_least(-1, -1)
    """Number of steps; -1: until Ctrl-C."""
    record: bool = False
    """Store samples and predictions in the session's dataset, mode "prediction"."""

    kind: ClassVar[str] = "prediction"
    learner: Learner = field(init=False, repr=False)
    source: Source = field(init=False, repr=False)
    dataset: Dataset | None = field(init=False, repr=False, default=None)
    batch: Batch = field(init=False, repr=False)
    prediction: Batch = field(init=False, repr=False)
    step_id: int = field(init=False, repr=False, default=0)

    def execute(self) -> None:
        """Run all steps.

        Raises:
            PhysxError: There is no network, or the environment failed.
        """
        with self._running():
            self.prediction_begin()
            while self.prediction_condition():
                self.sample_begin()
                self.predict()
                self.sample_end()
            self.prediction_end()

    def prediction_begin(self) -> None:
        """The first step is about to be made."""
        self.step_id = 0
        self.observers.begin("prediction", None if self.step_nb < 0 else self.step_nb, "steps")

    def prediction_condition(self) -> bool:
        """Return whether there are steps left."""
        return self.step_nb < 0 or self.step_id < self.step_nb

    def sample_begin(self) -> None:
        """A step is about to be made."""

    def predict(self) -> None:
        """Step the environment, ask the network, and give its answer to the environment."""
        self.batch = self.source.batch(self.source.instance_nb)
        self.prediction = self.learner.predict(self.batch)
        self.source.apply(self.prediction)
        if self.dataset is not None:
            self._store(self.dataset)

    def sample_end(self) -> None:
        """Count the step."""
        self.step_id += 1
        self.observers.advance(1)

    def prediction_end(self) -> None:
        """The last step is made."""
        self.observers.end()

    def _store(self, dataset: Dataset) -> None:
        """Store samples and predictions; a predicted field of a taken name gets a prefix."""
        predicted = {
            name if name not in self.batch else f"predicted_{name}": values
            for name, values in self.prediction.items()
        }
        if self.step_id == 0:
            added = [
                Field(name, values.shape[1:], values.dtype, role="additional")
                for name, values in predicted.items()
            ]
            dataset.define_fields("prediction", [*self.source.fields, *added])
        for row in range(self.source.instance_nb):
            sample = {name: values[row] for name, values in {**self.batch, **predicted}.items()}
            dataset.append_sample("prediction", sample)

    # Opening --------------------------------------------------------------------------------

    def _open(self, resources: contextlib.ExitStack) -> None:
        network, environment = self.network_config, self.environment_config
        seed = chosen_seed(environment.seed)
        self.session = Session.existing(self.session_dir, self.session_name)
        place = Path(network.network_dir) if network.network_dir else self.session.network_dir
        self.learner = restored(
            network, checkpoint.find(place, network.network_name, network.which_network)
        )
        self.dataset = None
        if self.record:
            config = self.dataset_config or DatasetConfig()
            self.dataset = resources.enter_context(open_own(self.session, config))
            self.dataset.update_info(prediction=describe_environment(environment, seed))
        self._record_config(seed)
        self._observe(resources, environment)
        self.source = self._open_source(
            resources,
            environment,
            stream_seed(seed, "prediction", 0),
            predict=self.learner.predict,
            in_process=True,
        )
