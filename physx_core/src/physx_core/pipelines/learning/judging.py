"""Judges a trained network at the end of its training."""

from __future__ import annotations

from dataclasses import dataclass, field

from physx_core.errors import ConfigError, PhysxError, listed, nearest
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.learning.learner import Learner
from physx_core.results import PartResult
from physx_core.results.errors import ERRORS
from physx_core.results.judge import Judge, Predictor


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
    return Predictor(
        learner.predict_in_training,
        network.net_fields,
        dict(zip(network.opt_fields, network.pred_fields, strict=False)),
        loss if isinstance(loss, str) else getattr(loss, "__name__", ""),
    )


def make_judge(learner: Learner, stored: StoredBatches) -> Judge:
    """Return what measures a network's errors.

    Args:
        learner: The network, which may go on learning.
        stored: The samples.
    """
    return Judge(predictor_of(learner), stored.training)


def judge(
    learner: Learner, stored: StoredBatches, seconds: float, used: str, known: Judge | None = None
) -> Judgment:
    """Judge a network on the samples that were held back; no error of it ends the run.

    Args:
        learner: The network.
        stored: The samples.
        seconds: Duration of the training in s.
        used: What the samples for validation decided about the network, in words.
        known: What measured its errors before, if anything.
    """
    if not (learner.network.opt_fields and learner.network.pred_fields):
        return Judgment(why="its fields have no true values (opt_fields)")
    try:
        unseen = stored.unseen(used)
        if not unseen:
            return Judgment(
                why='no samples were held back: generate some of the mode "validation", or hold '
                "back a part of stored ones (View.hold_back)"
            )
        judge = known or make_judge(learner, stored)
        judge.learn(seconds)
        return Judgment({name: judge.judge(part) for name, part in unseen.items()}, judge.rate)
    except Exception as error:  # the network is stored already: a run must not fail for its result
        reason = str(error) if isinstance(error, PhysxError) else repr(error)
        return Judgment(why=f"measuring it failed: {reason}")


def check_monitor(monitor: str, learner: Learner, *, validates: bool) -> None:
    """Check that a training has the error that `Training.monitor` names.

    Raises:
        ConfigError: If it has not.
    """
    pairs = zip(learner.network.opt_fields, learner.network.pred_fields, strict=False)
    known = [f"error/{name}/{error}" for name, _ in pairs for error in ERRORS]
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
