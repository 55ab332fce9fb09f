"""All checks of engines, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from physx_sim import Backend
from physx_sim.conformance import contacts, dynamics, features, motion, state
from physx_sim.conformance.worlds import build, busy
from physx_testing.process_state import unchanged
from physx_testing.report import Report
from physx_testing.running import TIMEOUT, run_checks
from physx_testing.subject import Check, Subject


def check_backend(
    component: str | type[Any] | Callable[..., Backend],
    *,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that an engine satisfies the contract of `Backend` and `Simulation`.

    Features that its simulations do not claim in `Simulation.features` are not checked.

    Args:
        component: Its class, a function that returns it, or a reference.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "backend",
        component,
        kwargs,
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _quiet(subject: Subject) -> None:
    for tries in range(2):
        if not tries:
            _run(subject)
            continue
        with unchanged(subject.before):
            _run(subject)


def _run(subject: Subject) -> None:
    with build(subject, busy(subject)) as simulation:
        simulation.step(50)


CHECKS: dict[str, Check] = {
    **state.CHECKS,
    **motion.CHECKS,
    **dynamics.CHECKS,
    **contacts.CHECKS,
    **features.CHECKS,
    "leaves its process as it was": _quiet,
}
