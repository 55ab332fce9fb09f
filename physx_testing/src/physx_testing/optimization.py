"""Contract checks for optimizations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core import checkpoint
from physx_core.components import Optimization
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, DivergedError
from physx_core.fields import Field
from physx_core.pipelines import Learner
from physx_testing.learning import SEED, Case, find_case, parameters_of
from physx_testing.process_state import unchanged
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, plain_options, run_checks
from physx_testing.subject import (
    Check,
    Subject,
    expect,
    expect_equal,
    refuses_unknown_options,
)

_BATCHES = 60
_ROWS = 16


def check_optimization(
    component: str | type[Any] | Callable[..., Optimization],
    *,
    network: NetworkConfig,
    fields: Sequence[Field] = (),
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that an optimization satisfies the contract of `Optimization`, on the CPU.

    It trains a network on a linear problem.

    Args:
        component: Its class, a function that returns it, or a reference.
        network: The network to train, with loss, optimizer and scheduler.
        fields: Fields of the network, inputs and targets; empty: several shapes are tried.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "optimization",
        component,
        kwargs,
        options=plain_options(fields=fields, network=network),
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _case(subject: Subject) -> Case:
    if subject.network is None:
        raise NotApplicableError("it needs a network to train")
    config = dataclasses.replace(
        subject.network,
        optimization=subject.reference,
        optimization_kwargs=dict(subject.arguments),
    )
    return find_case(config, subject.fields)


def _train(learner: Learner, case: Case, first: int, count: int) -> list[float]:
    """Return the loss of each batch."""
    return [
        learner.optimize(case.batch(_ROWS, seed=number))["loss"]
        for number in range(first, first + count)
    ]


def _learns(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(trains=True)
    losses = _train(learner, case, 0, _BATCHES)
    expect(all(map(math.isfinite, losses)), "a loss is NaN or infinite")
    begin, end = float(np.mean(losses[:5])), float(np.mean(losses[-5:]))
    expect(
        end < begin or begin == 0,
        f"after {_BATCHES} batches of a linear problem the loss is {end:.3g}; it was {begin:.3g}",
    )


def _steps_once(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(trains=True)
    before = parameters_of(learner.network)
    learner.mean_losses([case.batch(_ROWS)])
    expect_equal(
        parameters_of(learner.network),
        before,
        "compute_loss() and transform_loss() changed the parameters, which a validation must not",
    )
    _train(learner, case, 0, 5)
    after = parameters_of(learner.network)
    expect(
        any(not np.array_equal(after[name], before[name]) for name in before),
        "optimize() has not changed any of the network's parameters in 5 batches",
    )


def _row_losses(subject: Subject) -> None:
    case = _case(subject)
    learner, plain = case.learner(trains=True), case.learner(trains=True)
    for number in range(3):
        batch = case.batch(_ROWS, seed=number)
        try:
            learner.optimize(batch, by_row=True)
        except ConfigError as error:
            raise NotApplicableError(f"it has no row losses: {error}") from error
        expect(np.isfinite(learner.row_losses).all(), "the loss of a row is not finite")
        plain.optimize(batch)
    expect_equal(
        parameters_of(learner.network),
        parameters_of(plain.network),
        "with compute_row_losses() before optimize() it ends with different parameters",
    )


def _repeats(subject: Subject) -> None:
    case = _case(subject)
    first, second = case.learner(trains=True), case.learner(trains=True)
    _train(first, case, 0, 8)
    _train(second, case, 0, 8)
    expect_equal(
        parameters_of(second.network),
        parameters_of(first.network),
        "a second training on the same batches ends with different parameters",
    )


def _resumes(subject: Subject) -> None:
    case = _case(subject)
    whole = case.learner(trains=True)
    _train(whole, case, 0, 5)
    whole.epoch_end(1.0)
    progress = checkpoint.Progress(epoch=1, batch=0, batches_read=5, seed=SEED)
    place = whole.save(subject.folder / "network", progress)
    _train(whole, case, 5, 5)
    type(whole.network).set_seed(77)
    resumed = case.learner(trains=True, seed=78)
    resumed.resume(checkpoint.read(place))
    _train(resumed, case, 5, 5)
    expect_equal(
        parameters_of(resumed.network),
        parameters_of(whole.network),
        "a training resumed from a checkpoint ends with different parameters: save_state() must "
        "write to state_file everything that the next steps depend on",
    )


def _diverges(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(trains=True)
    _train(learner, case, 0, 2)
    before = parameters_of(learner.network)
    batch = case.batch(_ROWS, seed=2)
    name = case.network_fields[0]
    if batch[name].dtype.kind != "f":
        raise NotApplicableError("its network reads no real numbers")
    batch[name].reshape(_ROWS, -1)[0, 0] = np.nan
    try:
        learner.optimize(batch)
    except DivergedError as error:
        after = parameters_of(learner.network)
        if any(not np.array_equal(after[name], before[name]) for name in before):
            raise NotApplicableError(
                "it does not check the loss before changing the parameters; trainings do afterwards"
            ) from error
        return
    raise AssertionError("a batch with NaN is trained on without a word: its loss must be NaN, too")


def _epochs(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(trains=True)
    for number, loss in enumerate((1.0, math.nan, 0.5)):
        _train(learner, case, 2 * number, 2)
        learner.epoch_end(loss)
    rate = learner.learning_rate
    expect(rate is None or math.isfinite(rate), f"its learning rate is {rate}")


def _quiet(subject: Subject) -> None:
    case = _case(subject)
    _train(case.learner(trains=True), case, 0, 2)
    with unchanged(subject.before):
        _train(case.learner(trains=True), case, 0, 2)


CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    "lowers the loss": _learns,
    "changes parameters in optimize() alone": _steps_once,
    "computes row losses without side effects": _row_losses,
    "trains the same again": _repeats,
    "resumes from a checkpoint bit for bit": _resumes,
    "stops at NaN with the previous parameters": _diverges,
    "ends epochs, even those without validation": _epochs,
    "leaves its process as it was": _quiet,
}
