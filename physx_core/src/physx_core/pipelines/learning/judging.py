"""Judges a trained network at the end of its training."""

from __future__ import annotations

from dataclasses import dataclass, field

from physx_core.errors import PhysxError
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.learning.learner import Learner
from physx_core.results import PartResult
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


def judge(learner: Learner, stored: StoredBatches, seconds: float, used: str) -> Judgment:
    """Judge a network on the samples that were held back; no error of it ends the run.

    Args:
        learner: The network.
        stored: The samples.
        seconds: Duration of the training in s.
        used: What the samples for validation decided about the network, in words.
    """
    network, loss = learner.network, learner.config.loss
    predictor = Predictor(
        learner.predict_in_training,
        network.net_fields,
        dict(zip(network.opt_fields, network.pred_fields, strict=False)),
        loss if isinstance(loss, str) else getattr(loss, "__name__", ""),
    )
    if not predictor.pairs:
        return Judgment(why="its fields have no true values (opt_fields)")
    try:
        unseen = stored.unseen(used)
        if not unseen:
            return Judgment(
                why='no samples were held back: generate some of the mode "validation", or hold '
                "back a part of stored ones (View.hold_back)"
            )
        judge = Judge(predictor, stored.training, seconds)
        return Judgment({name: judge.judge(part) for name, part in unseen.items()}, judge.rate)
    except Exception as error:  # the network is stored already: a run must not fail for its result
        reason = str(error) if isinstance(error, PhysxError) else repr(error)
        return Judgment(why=f"measuring it failed: {reason}")
