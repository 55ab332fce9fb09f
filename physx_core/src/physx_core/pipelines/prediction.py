"""Prediction: feeds a trained network's predictions into the running simulation."""

from __future__ import annotations

import contextlib
import shlex
import signal
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

from physx_core.components.environment import not_finite_prediction
from physx_core.config import EnvironmentConfig, NetworkConfig, at_least, options
from physx_core.dataset import Dataset
from physx_core.fields import Field, first_not_finite, is_finite
from physx_core.pipelines.learning.learner import Learner
from physx_core.pipelines.learning.loading import load_learner
from physx_core.pipelines.pipeline import Pipeline, choose_seed, derive_seed
from physx_core.pipelines.run_description import (
    describe_environment_config,
    describe_learner,
    describe_samples,
)
from physx_core.pipelines.storage import (
    GENERATIONS,
    describe_environment,
    end_generation,
    open_existing,
    open_own,
    record_beside_rows,
    reject_client_writers,
)
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.processes import deferred_interrupt
from physx_core.results import Result
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.typing import Batch
from physx_core.views.dataset_config import DatasetConfig

_NOTHING = contextlib.nullcontext()


@options
@dataclass(eq=False)
class Prediction(Pipeline):
    """Steps the environments and applies the network's predictions to them.

    A single environment runs in this process. Several (``num_clients``) run in clients, or in this
    process with ``as_tcp_ip_client=False``; the numbers are the same. In each step every instance
    generates one sample, the network predicts for all of them as one batch, row i for instance
    i + 1, and each instance gets its row through `Environment.apply_prediction`. Requests through
    `Environment.get_prediction` are answered one by one in this process, but as one batch for all
    clients, which a network may round differently.

    With ``load_samples``, the environments replay stored samples of mode ``dataset_config.mode``,
    from ``dataset_config.existing_dir`` if set, otherwise from the session, in the order of
    writing. Each step takes one sample per instance, available as `Environment.sample`. After the
    last sample it starts over. The dataset is only read.

    Attributes:
        learner: The network and its transformation, from the session's checkpoint.
        source: The environments.
        dataset: The session's own dataset, open for writing; None if samples are not recorded.
        batch: The current samples, one row for each instance of the environment.
        prediction: The network's prediction for them, in physical units.
        step_id: Number of finished steps.
    """

    network_config: NetworkConfig
    """The network; `NetworkConfig()` takes everything from the session's checkpoint."""
    environment_config: EnvironmentConfig
    """The environment, and where its instances run."""
    dataset_config: DatasetConfig | None = None
    """The stored samples to replay, and how samples are recorded; None: the session's own."""
    _: KW_ONLY
    session_name: str = "training"
    """Name of the session whose network predicts."""
    step_nb: int = at_least(-1, -1)
    """Number of steps; -1: until Ctrl-C."""
    record: bool = False
    """Store samples and predictions in the session's dataset, mode "prediction"; with
    `record_wrong_samples` also rejected samples."""
    trust: bool = field(default=False, metadata={"recorded": False})
    """Import whatever code the checkpoint names, not only components of installed plugins."""

    kind: ClassVar[str] = "prediction"
    learner: Learner = field(init=False, repr=False)
    source: Source = field(init=False, repr=False)
    dataset: Dataset | None = field(init=False, repr=False, default=None)
    batch: Batch = field(init=False, repr=False)
    prediction: Batch = field(init=False, repr=False)
    step_id: int = field(init=False, repr=False, default=0)
    _stored: StoredRows | None = field(init=False, repr=False, default=None)
    _is_asked: bool = field(init=False, repr=False, default=False)

    def execute(self) -> Result:
        """Run all steps. Ctrl-C and SIGTERM end the run cleanly after the current step.

        Raises:
            PhysxError: If there is no network, or the environment fails.
            KeyboardInterrupt: After Ctrl-C before ``step_nb`` steps; a second signal ends the run
                immediately.
            SystemExit: After SIGTERM, with status 143.
        """
        with self._running(), deferred_interrupt() as interrupt:
            total = None if self.step_nb < 0 else self.step_nb
            self.observers.begin("prediction", total, "steps")
            self.prediction_begin()
            own = self._is_own(Prediction.predict)
            while (more := self.prediction_condition()) and not interrupt:
                self.sample_begin()
                if own:
                    self.predict()
                else:
                    self._check_predict()
                self.sample_end()
            self._check_condition(more, "prediction_condition")
            self.prediction_end()
            unfinished = self.step_nb >= 0 and self.prediction_condition()
            if interrupt.number == signal.SIGTERM or (interrupt and unfinished):
                interrupt.end()
        return self.result

    def prediction_begin(self) -> None:
        """Called before the first step."""

    def prediction_condition(self) -> bool:
        """Return whether there are steps left."""
        return self.step_nb < 0 or self.step_id < self.step_nb

    def sample_begin(self) -> None:
        """Called before each step."""

    def predict(self) -> None:
        """Step the environments, predict, and apply the predictions; then count the step."""
        count, dataset = self.source.instance_nb, self.dataset
        beside = record_beside_rows(self.source, dataset, "prediction") if dataset else _NOTHING
        with beside:
            stored = None if self._stored is None else self._stored.take_cyclic(count)
            self.batch = self.source.batch(count, stored)
            self.prediction = self.learner.predict(self.batch)
            self._check(self.prediction)
            self.source.apply(self.prediction)
            if dataset:
                self._store(dataset)
        self._count_step()

    def _count_step(self) -> None:
        self.step_id += 1
        self.observers.advance(1)

    def _check_predict(self) -> None:
        """Call a replacement of `predict`, which need not count the step."""
        begins, earlier = self.step_id, self.batch
        stored = self.dataset.num_samples("prediction") if self.dataset and not begins else -1
        self.predict()
        if self.batch is earlier or not self.prediction:
            how = "set self.batch = self.source.batch(...) and self.prediction"
            raise self._lacks("predict", "set no batch and prediction", how)
        if self.dataset and self.dataset.num_samples("prediction") == stored:
            how = 'store them with self.dataset.append("prediction", ...)'
            raise self._lacks("predict", "recorded no samples", how)
        if self.step_id == begins:
            self._count_step()

    def _check(self, prediction: Batch) -> None:
        """Check that the prediction is finite."""
        for name, values in prediction.items():
            if not is_finite(values):
                row = first_not_finite(values)
                instance_id, step = (int(self.batch[key][row]) for key in ("env_id", "step"))
                raise not_finite_prediction(name).at(instance_id, step)

    def sample_end(self) -> None:
        """Called after each step."""

    def prediction_end(self) -> None:
        """Called after the last step."""

    def _store(self, dataset: Dataset) -> None:
        """Store samples and predictions; predicted fields get a prefix if their name is taken."""
        predicted = {
            name if name not in self.batch else f"predicted_{name}": values
            for name, values in self.prediction.items()
        }
        if self.step_id == 0:
            shapes = map(self.learner.predicted_shape, self.prediction, predicted.values())
            added = [
                Field(name, shape, values[0].dtype, role="additional")
                for (name, values), shape in zip(predicted.items(), shapes, strict=True)
            ]
            dataset.define_fields("prediction", [*self.source.fields, *added])
        for row in range(self.source.instance_nb):
            sample = {name: values[row] for name, values in {**self.batch, **predicted}.items()}
            dataset.append_sample("prediction", sample)

    # Opening --------------------------------------------------------------------------------

    def _begin(self) -> None:
        self.step_id, self.batch, self.prediction = 0, {}, {}

    def _open(self, resources: contextlib.ExitStack) -> None:
        network, environment = self.network_config, self.environment_config
        seed = choose_seed(environment.seed)
        self.session = Session.existing(self.session_dir, self.session_name)
        self.learner = load_learner(self.session.path, network, trust=self.trust)
        config = self.dataset_config or DatasetConfig()
        reject_client_writers(config, "a prediction")
        self._stored, replayed = None, None
        if environment.load_samples:
            existing = resources.enter_context(open_existing(self.session, config))
            self._stored, replayed = StoredRows(existing, config.mode), existing.directory
        self.dataset = None
        if self.record:
            self.dataset = resources.enter_context(open_own(self.session, config))
            self.dataset.update_info(prediction=describe_environment(environment, seed))
            end_generation(self.dataset, *GENERATIONS)
        self._record_config(seed)
        self._observe(resources, environment)
        self.source = self._open_source(
            resources,
            environment,
            derive_seed(seed, "prediction", 0),
            predict=self._answer,
            run_ahead=0,
            in_process=environment.num_clients == 1,
            replayed=replayed,
        )

    def _answer(self, request: Batch) -> Batch:
        self._is_asked = True
        return self.learner.answer(request)

    def _plan(self) -> Iterable[str]:
        if self.step_nb < 0:
            yield "runs until Ctrl-C; step_nb (--step-nb) limits the number of steps"

    @property
    def _is_without_effect(self) -> bool:
        """Whether nothing used the predictions; what subclasses do with them is unknown."""
        return type(self) is Prediction and not self._is_asked and self.source.ignores_predictions

    def _results(self, error: BaseException | None) -> Iterable[str]:
        yield f"{self.step_id} steps with {self.learner.config.network}"
        if self.dataset is not None:
            yield describe_samples(self.dataset.directory)
        elif error is None and self._is_without_effect:
            yield (
                "nothing used the predictions: the environment does not define apply_prediction, "
                "and record (--record) is off"
            )

    def _next(self, error: BaseException | None) -> Iterable[str]:
        if self.dataset is not None:
            yield f"physx info {shlex.quote(str(self.session.path))}"

    def _components(self) -> Mapping[str, str]:
        return {
            **describe_learner(self.learner),
            "environment": describe_environment_config(self.environment_config),
        }
