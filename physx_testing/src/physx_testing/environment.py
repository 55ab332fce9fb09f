"""Contract checks for environments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from physx_core.components import Environment, Visualizer
from physx_core.config import EnvironmentConfig
from physx_core.errors import NotFiniteError, StateError
from physx_core.rows import ROW_FIELDS, RowBuffer, infer_shapes
from physx_core.sources import ClientSource, LocalSource
from physx_core.typing import Batch
from physx_testing.instances import (
    SEED,
    Services,
    config_of,
    in_another_process,
    one_instance,
    rows_between,
)
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

_ROWS = 6
_DISTURBED = (
    "rows that follow a state differ from those without one, as an engine may discard memory of "
    "its last step there: take states after the same rows in each run"
)


def check_environment(
    component: str | type[Any] | Callable[..., Environment],
    *,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that an environment satisfies the contract of `Environment`, here and in clients.

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
        "environment",
        component,
        kwargs,
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _rows(
    subject: Subject,
    count: int = _ROWS,
    instances: int = 1,
    *,
    seed: tuple[int, ...] = SEED,
    stored: Batch | None = None,
    services: Services | None = None,
    **options: Any,
) -> Batch:
    """Return rows that instances in this process generate."""
    config = config_of(subject, instances, **options)
    with LocalSource(config, services or Services(), seed) as source:
        found = source.batch(count, stored)
        return {name: values.copy() for name, values in found.items()}


def _refuses(subject: Subject) -> None:
    refuses_unknown_options(subject, _open)


def _open(subject: Subject) -> None:
    with one_instance(subject):
        pass


def _steps(subject: Subject) -> None:
    with one_instance(subject) as instance:
        promised = {field.name: field for field in instance.fields}
        for step in range(_ROWS):
            sample = instance.step()
            buffer = RowBuffer(infer_shapes(promised.values(), sample), 1)
            try:
                buffer.put(sample, 1, instance.last_episode, instance.last_step, finite=True)
            except NotFiniteError as error:
                raise AssertionError(
                    f"step {step} gave a sample that cannot be stored: {error}"
                ) from error
        expect(
            [field.name for field in instance.fields] == list(promised),
            "it defined further fields after init_database()",
        )


def _repeats(subject: Subject) -> None:
    first = _rows(subject)
    expect_equal(_rows(subject), first, "a second run with the same seed has different rows")


def _uses_seed(subject: Subject) -> None:
    first, other = _rows(subject), _rows(subject, seed=(6, 0, 0))
    own = first.keys() - {field.name for field in ROW_FIELDS}
    if all(np.array_equal(first[name], other[name]) for name in own):
        raise NotApplicableError(
            "another seed gives the same rows, and so does each client: if that is not intended, "
            "draw from self.rng"
        )


def _independent(subject: Subject) -> None:
    together = _rows(subject, 2 * _ROWS, 2)
    for number in (1, 2):
        mine = together["env_id"] == number
        with one_instance(subject, number, 2) as instance:
            buffer: RowBuffer | None = None
            for _ in range(_ROWS):
                sample = instance.step()
                if buffer is None:
                    buffer = RowBuffer(infer_shapes(instance.fields, sample), _ROWS)
                buffer.put(sample, number, instance.last_episode, instance.last_step)
        assert buffer is not None
        expect_equal(
            {name: values[mine] for name, values in together.items()},
            buffer.take(),
            f"instance {number} generates different rows next to a second instance than alone: "
            "they share something, such as an attribute of the class or module",
        )


def _over_tcp(subject: Subject) -> None:
    wanted = _rows(subject, 2 * _ROWS, 2)
    config = EnvironmentConfig(subject.reference, env_kwargs=dict(subject.arguments), num_clients=2)
    with ClientSource(config, Services(), SEED, total=2 * _ROWS) as source:
        found = source.batch(2 * _ROWS)
        expect_equal(found, wanted, "clients' rows differ from those generated in this process")


def _draws(subject: Subject) -> None:
    plain = _rows(subject)
    services = Services()
    drawn = _rows(subject, services=services, visualizer=Visualizer)
    expect_equal(drawn, plain, "with a visualizer it generates different rows than without")
    if not services.drawn:
        raise NotApplicableError("it draws nothing")


def _replays(subject: Subject) -> None:
    if not _reads_samples(subject):
        raise NotApplicableError("it never reads Environment.sample, so it replays nothing")
    rows = _rows(subject)
    stored = {name: rows[name] for name in rows if name not in {f.name for f in ROW_FIELDS}}
    first, second = _rows(subject, stored=stored), _rows(subject, stored=stored)
    expect_equal(second, first, "a second replay of the same rows has different results")


def _reads_samples(subject: Subject) -> bool:
    with one_instance(subject) as instance:
        instance.step()
        assert instance.environment is not None
        return instance.environment._has_read_sample


def _many_steps(subject: Subject) -> None:
    first = _rows(subject, 3, simulations_per_step=2)
    again = _rows(subject, 3, simulations_per_step=2)
    expect_equal(again, first, "with two simulations per row, a second run has different rows")


def _rows_with_states(subject: Subject) -> tuple[list[Batch], dict[int, bytes]]:
    """Return rows, and the states that were taken between them."""
    states: dict[int, bytes] = {}
    with one_instance(subject) as instance:
        try:
            instance.track_states()
            return rows_between(instance, 0, states), states
        except StateError as error:
            raise NotApplicableError(str(error)) from error


def _continues(subject: Subject) -> None:
    rows, states = _rows_with_states(subject)
    for made, found in in_another_process(subject, states).items():
        for row, wanted in enumerate(rows[made:], made):
            what = f"row {row} differs in another process that got the state after {made} rows"
            expect_equal(found[row - made], wanted, what)


def _is_not_disturbed(subject: Subject) -> None:
    rows, _ = _rows_with_states(subject)
    with one_instance(subject) as instance:
        for found, wanted in zip(rows, rows_between(instance, 0, None), strict=True):
            if any(not np.array_equal(wanted[name], found[name]) for name in wanted):
                raise NotApplicableError(_DISTURBED)


def _forks(subject: Subject) -> None:
    with one_instance(subject) as instance:
        try:
            instance.track_states()
            rows_between(instance, _ROWS, None)
            with instance.fork() as fork:
                ahead = rows_between(fork, _ROWS, None)
        except StateError as error:
            raise NotApplicableError(str(error)) from error
        here = rows_between(instance, _ROWS, None)
    for row, (found, wanted) in enumerate(zip(ahead, here, strict=True)):
        expect_equal(found, wanted, f"row {row} after fork() differs in the fork")


def _closes(subject: Subject) -> None:
    made = subject.make(instance_id=1, instance_nb=1, seed=list(SEED))
    _close(made, "before create(), as after a failure there")
    with one_instance(subject) as instance:
        instance.step()
        environment = instance.environment
    assert environment is not None
    _close(environment, "a second time")


def _close(environment: Environment, when: str) -> None:
    try:
        environment.close()
    except Exception as error:
        raise AssertionError(f"close() {when} raised {type(error).__name__}: {error}") from error


def _quiet(subject: Subject) -> None:
    """Compare the state of the process before and after the environment exists."""
    _rows(subject)  # imports during the first run may start threads that stay
    with unchanged(subject.before):
        _rows(subject)


def _takes_identity(subject: Subject) -> None:
    for number in (1, 3):
        made = subject.make(instance_id=number, instance_nb=3, seed=list(SEED))
        expect(
            (made.instance_id, made.instance_nb) == (number, 3),
            f"it is instance {made.instance_id} of {made.instance_nb}, though it was created as "
            f"{number} of 3",
        )
        made.close()


CHECKS: dict[str, Check] = {
    "takes its place among the instances": _takes_identity,
    "refuses unknown options": _refuses,
    "gives every field in each step, finite and of its shape and type": _steps,
    "gives the same rows with the same seed": _repeats,
    "gives other rows with another seed": _uses_seed,
    "does not disturb another instance": _independent,
    "steps several times per row": _many_steps,
    "gives the same rows from clients over TCP": _over_tcp,
    "draws without an effect on its rows": _draws,
    "replays stored rows": _replays,
    "continues from its state in another process": _continues,
    "gives the same rows when states are taken": _is_not_disturbed,
    "goes on alike in a fork": _forks,
    "closes at any time, even twice": _closes,
    "leaves its process as it was": _quiet,
}
