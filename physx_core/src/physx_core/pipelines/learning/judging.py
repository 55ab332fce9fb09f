"""Judges a network: what decides in its training, and how good it is at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from physx_core.errors import ComponentNotFoundError, ConfigError, PhysxError, listed, nearest
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.learning.learner import Learner
from physx_core.plugins import import_component
from physx_core.results import PartResult
from physx_core.results.errors import ERRORS, as_loss
from physx_core.results.judge import DEFAULT, Judge, Predictor
from physx_core.results.metrics import Metric
from physx_core.results.rivals import Predict


@dataclass(frozen=True)
class Judgment:
    """How good a network is.

    Attributes:
        parts: Its errors on samples that it has not learned from: see `Result.parts`.
        rate: Number of samples that it predicts per s; NaN if it was not judged.
        why: Why it was not judged; empty if it was.
    """

    parts: dict[str, PartResult] = field(default_factory=dict)
    rate: float = float("nan")
    why: str = ""


NOT_JUDGED = Judgment(why='rivals is "none"')


def predictor_of(learner: Learner) -> Predictor:
    """Return a network as it is judged; it may go on learning."""
    network, loss = learner.network, learner.config.loss
    table = loss if isinstance(loss, Mapping) else dict.fromkeys(network.opt_fields, loss)
    return Predictor(
        learner.predict_in_training,
        network.net_fields,
        dict(zip(network.opt_fields, network.pred_fields, strict=False)),
        {name: getattr(one, "__name__", str(one)) for name, one in table.items()},
    )


class Judging:
    """Measures a training's network on samples that it does not learn from.

    Attributes:
        measures: Whether errors are measured in each validation.
        judges: Whether the network is judged at the end.
    """

    def __init__(
        self,
        learner: Learner,
        stored: StoredBatches,
        monitor: str | None,
        metrics: Mapping[str, Metric],
        rivals: Mapping[str, Predict | None] | None,
        *,
        validates: bool,
    ) -> None:
        """Check that there is what decides.

        Args:
            learner: The network.
            stored: The samples.
            monitor: See `Training.monitor`.
            metrics: See `find_metrics`.
            rivals: See `find_rivals`.
            validates: Whether there are validations.

        Raises:
            ConfigError: If there is not.
        """
        self.measures = validates and bool(monitor or metrics)
        self.judges = rivals is not None
        self._learner, self._stored, self._monitor = learner, stored, monitor
        self._metrics, self._rivals = metrics, rivals
        self._judge: Judge | None = None
        if monitor is not None:
            self._check_monitor(monitor, validates=validates)

    def _check_monitor(self, monitor: str, *, validates: bool) -> None:
        network = self._learner.network
        pairs = zip(network.opt_fields, network.pred_fields, strict=False)
        known = [f"error/{name}/{error}" for name, _ in pairs for error in ERRORS]
        known += [f"metric/{name}" for name in self._metrics]
        if monitor not in known:
            raise ConfigError(
                f"Training.monitor is {monitor!r}, which is no error of this network."
                f"{nearest(monitor, known)} It has: {listed(known)}."
            )
        if not validates:
            raise ConfigError(
                f"Training.monitor is {monitor!r}, an error on validation samples, but nothing is "
                "validated: set validation_every, and hold samples back (View.hold_back)."
            )

    def _begin(self) -> Judge:
        if self._judge is None:
            of = predictor_of(self._learner), self._stored.training
            self._judge = Judge(*of, self._metrics, self._rivals)
        return self._judge

    def measure(self) -> dict[str, float]:
        """Return the network's errors on the validation samples by the names of `Result.values`."""
        return self._begin().measure(self._stored.validation)

    def deciding(self, errors: Mapping[str, float], loss: float) -> float:
        """Return what decides, of which the smallest is the best.

        Args:
            errors: What `measure` returned.
            loss: The validation loss, which decides if nothing else does.

        Raises:
            ConfigError: If the field has no such error.
        """
        if self._monitor is None:
            return loss
        if self._monitor not in errors:
            raise ConfigError(
                f"Training.monitor is {self._monitor!r}, but the errors of this field are: "
                f"{listed(errors)}."
            )
        return as_loss(self._monitor, errors[self._monitor])

    def judge(self, seconds: float, used: str) -> Judgment:
        """Judge the network on the samples that were held back; no error of it ends the run.

        Args:
            seconds: Duration of the training in s.
            used: What the samples for validation decided about the network, in words.
        """
        if not (self._learner.network.opt_fields and self._learner.network.pred_fields):
            return Judgment(why="its fields have no true values (opt_fields)")
        try:
            unseen = self._stored.unseen(used)
            if not unseen:
                return Judgment(
                    why='no samples were held back: generate some of the mode "validation", or '
                    "hold back a part of stored ones (View.hold_back)"
                )
            judge = self._begin()
            judge.learn(seconds)
            return Judgment({name: judge.judge(part) for name, part in unseen.items()}, judge.rate)
        except Exception as error:  # the network is stored: a run must not fail for its result
            reason = str(error) if isinstance(error, PhysxError) else repr(error)
            return Judgment(why=f"measuring it failed: {reason}")


def find_metrics(given: Sequence[Any]) -> dict[str, Metric]:
    """Return the metrics that `Training.metrics` names, by name.

    Raises:
        ConfigError: If one does not exist, is no function, or has the name of another.
    """
    return _find_functions("metric", given, "predictions and true values")


def find_rivals(given: str | Sequence[Any]) -> dict[str, Predict | None] | None:
    """Return the rivals that `Training.rivals` names, as in `Judge`; None if there is no judging.

    Raises:
        ConfigError: If one does not exist, is no function, or has the name of another.
    """
    given = [given] if isinstance(given, str) else given
    if list(given) == ["none"]:
        return None
    own = [each for each in given if each != "all"]
    found: dict[str, Predict | None] = dict.fromkeys(DEFAULT if "all" in given else ())
    return found | _find_functions("rival", own, 'the inputs (nor "all" or "none")')


def _find_functions(kind: str, given: Sequence[Any], of: str) -> dict[str, Any]:
    option, found = f"Training.{kind}s", {}
    for each in given:
        function = each
        if isinstance(each, str):
            try:
                function = import_component(kind, each) if ":" in each else None
            except ComponentNotFoundError as error:
                known = nearest(error.name, error.known)
                raise ConfigError(f'There is no {kind} "{each}".{known}') from error
        name = getattr(function, "__name__", "")
        if not callable(function) or not name:
            raise ConfigError(
                f"{option} names {each!r}, which is no function of {of}: "
                'name one as "package.module:function" or "script.py:function".'
            )
        if name in found:
            raise ConfigError(f"{option} has two functions with the name {name}.")
        found[name] = function
    return found
