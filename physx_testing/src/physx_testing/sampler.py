"""Contract checks for samplers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components import LearningSampler, Parameter, Sampler, checked
from physx_core.typing import Batch
from physx_testing.process_state import unchanged
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, run_checks
from physx_testing.subject import (
    Check,
    Subject,
    expect,
    expect_equal,
    refuses_unknown_options,
)

_PARAMETERS = (
    Parameter("stiffness", 10.0, 40.0),
    Parameter("viscosity", 0.01, 1.0, distribution="log_uniform"),
    Parameter("push", [-1.0, 0.0], [1.0, 2.0], shape=(2,)),
    Parameter("cells", 1, 4, distribution="integer"),
)
_SEED = (5, 0, 0)
_SETS = 40
_BATCHES = 6


def check_sampler(
    component: str | type[Any] | Callable[..., Sampler],
    *,
    parameters: Sequence[Parameter] = (),
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a sampler satisfies the contract of `Sampler` or `LearningSampler`.

    Args:
        component: Its class, a function that returns it, or a reference.
        parameters: What it chooses; empty: four parameters with bounds, one of which has two
            elements and one whole numbers.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "sampler",
        component,
        kwargs,
        options={"parameters": [each.to_dict() for each in parameters]} if parameters else {},
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _parameters(subject: Subject) -> list[Parameter]:
    return subject.parameters or list(_PARAMETERS)


def _begun(subject: Subject, seed: Sequence[int] = _SEED) -> Sampler:
    sampler: Sampler = subject.make()
    sampler.begin(_parameters(subject), seed)
    return sampler


def _learning(subject: Subject) -> LearningSampler:
    sampler = _begun(subject)
    if not isinstance(sampler, LearningSampler):
        raise NotApplicableError("it does not learn from losses")
    return sampler


def _flat(values: Mapping[str, Any], number: int) -> Batch:
    return {f"{name} of set {number}": np.array(value) for name, value in values.items()}


def _asked(sampler: Sampler, numbers: Sequence[int]) -> Batch:
    found: Batch = {}
    for number in numbers:
        found |= _flat(sampler.ask(number), number)
    return found


def _chooses(subject: Subject) -> None:
    parameters, sampler = _parameters(subject), _begun(subject)
    for number in (*range(_SETS), 12345):
        values = checked(parameters, sampler.ask(number))
        for parameter in parameters:
            expect(
                parameter.contains(values[parameter.name]),
                f'set {number} has "{parameter.name}" = {values[parameter.name]}, which is not '
                "within its bounds",
            )


def _repeats(subject: Subject) -> None:
    numbers = range(_SETS)
    first = _asked(_begun(subject), numbers)
    expect_equal(
        _asked(_begun(subject), numbers),
        first,
        "a second run with the same seed chooses differently",
    )


def _begun_for_any_order(subject: Subject) -> Sampler:
    sampler = _begun(subject)
    if isinstance(sampler, LearningSampler):
        raise NotApplicableError("it learns, so it is asked once for each set, in order")
    return sampler


def _in_any_order(subject: Subject) -> None:
    first = _asked(_begun_for_any_order(subject), range(_SETS))
    backward = _asked(_begun(subject), [*reversed(range(_SETS))])
    expect_equal(
        {name: backward[name] for name in first},
        first,
        "asked for sets in reverse order, it chooses differently",
    )
    sampler = _begun(subject)
    for number in (7, 7, 3, 7):
        expect_equal(
            _asked(sampler, [number]),
            {name: first[name] for name in first if name.endswith(f" of set {number}")},
            "asked for a set again, or after skipping some, it chooses differently",
        )


def _own(subject: Subject) -> None:
    sampler = _begun_for_any_order(subject)
    values = sampler.ask(2)
    kept = copy.deepcopy(dict(values))
    for value in values.values():
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value.fill(0)
    if isinstance(values, dict):
        values.clear()
    expect_equal(
        _asked(sampler, [2]),
        _flat(kept, 2),
        "a set that was changed by its user is different when asked for again",
    )


def _begins_again(subject: Subject) -> None:
    sampler = _begun(subject)
    first = _asked(sampler, range(_SETS))
    sampler.begin(_parameters(subject), _SEED)
    expect_equal(
        _asked(sampler, range(_SETS)), first, "after a second begin() it chooses differently"
    )


def _losses(batch: int) -> tuple[list[int], Any]:
    """Return the sets of a batch and their losses, which differ widely in magnitude."""
    numbers = [3 * batch + place for place in range(3)]
    return numbers, np.exp(np.sin(1.0 + np.array(numbers, np.float64)) * 3)


def _tell(sampler: LearningSampler, batch: int) -> None:
    numbers, losses = _losses(batch)
    values = [sampler.ask(number) for number in numbers]
    sampler.tell(np.array(numbers), values, losses)


def _told(subject: Subject, batches: int) -> LearningSampler:
    sampler = _learning(subject)
    for batch in range(batches):
        _tell(sampler, batch)
    return sampler


def _next(sampler: LearningSampler, batches: int = _BATCHES) -> Batch:
    return _asked(sampler, range(3 * batches, 3 * batches + 20))


def _learns(subject: Subject) -> None:
    expect_equal(
        _next(_told(subject, _BATCHES)),
        _next(_told(subject, _BATCHES)),
        "told the same losses, a second run chooses differently",
    )


def _continues(subject: Subject) -> None:
    sampler, resumed = _told(subject, _BATCHES), _learning(subject)
    state = np.array(sampler.state())
    try:
        resumed.restore(state)
    except ValueError as error:
        if not state.size:
            raise NotApplicableError(f"it has no state: {error}") from error
        raise
    expect_equal(_next(resumed), _next(sampler), "restored from its state, it chooses differently")
    for one in (sampler, resumed):
        _tell(one, _BATCHES + 7)
    expect_equal(
        _next(resumed, _BATCHES + 8),
        _next(sampler, _BATCHES + 8),
        "restored from its state and told more losses, it chooses differently",
    )


def _refuses(subject: Subject) -> None:
    sampler = _learning(subject)
    try:
        sampler.restore(np.array([3.0, 1e6, 0.5]))
    except ValueError:
        return
    raise AssertionError("restore() accepted an invalid state; it must raise ValueError")


def _quiet(subject: Subject) -> None:
    _asked(_begun(subject), range(3))
    with unchanged(subject.before):
        sampler = _begun(subject)
        _asked(sampler, range(_SETS))
        if isinstance(sampler, LearningSampler):
            _tell(sampler, 0)


CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    "chooses every parameter within its bounds": _chooses,
    "chooses the same again": _repeats,
    "chooses the same in any order": _in_any_order,
    "hands out copies of its sets": _own,
    "begins again": _begins_again,
    "learns the same again": _learns,
    "continues from a state": _continues,
    "refuses an invalid state": _refuses,
    "leaves its process as it was": _quiet,
}
