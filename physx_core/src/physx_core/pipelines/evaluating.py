"""Evaluates a trained network: its errors on unseen samples, and what becomes of them over time."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from physx_core import plugins
from physx_core.errors import DatasetError, SessionError, UsageError
from physx_core.pipelines.learning.judging import predictor_of
from physx_core.pipelines.learning.unseen import Unseen, open_unseen
from physx_core.results import EpisodeError, PartResult, Result, read_results
from physx_core.results.judge import Judge, Judged
from physx_core.results.rivals import NotRunError
from physx_core.results.rollouts import Trace, roll_out, trace
from physx_core.results.stored import store_result
from physx_core.typing import Array, Batch

_SECONDS = 60.0
"""Duration of a training that is not known."""


def evaluate(
    session: str | Path,
    data: str | Path | None = None,
    *,
    mode: str | None = None,
    steps: int | None = None,
    invariants: Sequence[str | Callable[[Batch], Array]] = (),
    trust: bool = False,
) -> Result:
    """Measure how good a session's last network is; the session keeps the result.

    Its errors are compared with those of predictions that need no network. If it predicts the same
    quantity as one of its inputs, the predictions are fed back as well, from the beginning of
    episodes, with the other inputs as they were.

    Args:
        session: The session's folder.
        data: A dataset from which it did not learn, also of another resolution; None: the samples
            that were held back in the training.
        mode: The mode of that dataset; None: that of the training.
        steps: Largest number of rows to predict in a rollout; None: to the end of the episodes.
        invariants: Functions, or references to them as ``"module:function"`` or
            ``"script.py:function"``, of what the physics keeps, such as an energy: each gets values
            and parameters by name, arrays of shape (rows, ...), and returns shape (rows,).
        trust: Whether to import whatever code the checkpoint names.

    Raises:
        CheckpointError: If there is no network, or it is damaged.
        UntrustedReferenceError: If it names code that is not trusted.
        DatasetError: If the samples are not there, or have other fields.
        UsageError: If the network has no true values, learned from that dataset, or there is
            nothing to feed back to which `steps` and `invariants` apply.
    """
    begin = time.monotonic()
    if steps is not None and steps < 1:
        raise UsageError(f"steps is {steps} but must be at least 1.")
    named = dict(map(_named, invariants))
    former = _former(session)
    with open_unseen(session, data, mode=mode, trust=trust) as unseen:
        network = predictor_of(unseen.learner)
        if not network.pairs:
            raise UsageError(f"The network of {session} has no true values (opt_fields).")
        if not unseen.parts:
            raise DatasetError(
                f"No samples were held back from the training of {session}: name another dataset."
            )
        judge = Judge(network, unseen.training)
        judge.learn(former.seconds if former else _SECONDS)
        known = former.parts if former else {}
        judged = {name: _judged(unseen, name, known, data) for name in unseen.parts}
        parts = {name: judge.judge(part) for name, part in judged.items()}
        which = "test" if "test" in unseen.parts else next(iter(unseen.parts))
        batches, why = unseen.parts[which], ""
        try:
            rollouts = roll_out(
                network, batches, judge.targets, part=which, steps=steps, invariants=named
            )
        except NotRunError as error:
            rollouts, why = {}, str(error)
            if steps is not None or named:
                raise UsageError(f"Predictions cannot be fed back: {why}.") from error
        path = str(next(iter(batches.datasets.values())).directory)
        result = Result(
            "evaluation",
            str(session),
            time.monotonic() - begin,
            [f"predictions are not fed back, as {why}"] if why else [],
            {"predicted samples per s": judge.rate},
            parts,
            rollouts,
            places={"dataset": path},
        )
    with contextlib.suppress(SessionError):  # of somebody else, who may only read it
        store_result(Path(session), result)
    return result


def trace_episode(unseen: Unseen, part: str, episode: EpisodeError) -> Trace:
    """Feed predictions back in an episode of a result's rollouts, and keep them.

    Args:
        unseen: The network and the samples.
        part: The part that has the episode: `RolloutResult.part`.
        episode: The episode: one of `RolloutResult.episode_errors`.

    Raises:
        UsageError: If there is no such episode, or nothing to feed back.
    """
    network = predictor_of(unseen.learner)
    try:
        targets = Judge(network, unseen.training).targets
        return trace(network, unseen.parts[part], targets, episode.about)
    except NotRunError as error:
        raise UsageError(f"Predictions cannot be fed back: {error}.") from error


def _former(session: str | Path) -> Result | None:
    with contextlib.suppress(SessionError):
        return read_results(session).get("training")
    return None


def _judged(
    unseen: Unseen, name: str, known: Mapping[str, PartResult], data: str | Path | None
) -> Judged:
    batches = unseen.parts[name]
    if data is not None:
        return Judged(batches, "block" not in batches.group_nouns, "", place=str(data))
    used = known[name].used if name in known else ""
    return Judged.of(batches, has_mode=unseen.has_mode and name == "validation", used=used)


def _named(given: str | Callable[[Batch], Array]) -> tuple[str, Callable[[Batch], Array]]:
    if isinstance(given, str):
        return given.rpartition(":")[2], plugins.import_component("function", given)
    return getattr(given, "__name__", "invariant"), given
