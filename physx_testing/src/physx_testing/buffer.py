"""Contract checks for buffers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from physx_core.components import BatchSelection, Buffer
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

_BATCH = 8
_BATCHES = 40
_SEED = 5


def check_buffer(
    component: str | type[Any] | Callable[..., Buffer],
    *,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a buffer satisfies the contract of `Buffer`, with 40 batches of 8 rows.

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
        "buffer",
        component,
        kwargs,
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _begun(subject: Subject, seed: int = _SEED) -> Buffer:
    buffer: Buffer = subject.make()
    buffer.begin(_BATCH, _BATCHES, seed)
    return buffer


def _keeping(subject: Subject, seed: int = _SEED) -> Buffer:
    buffer = _begun(subject, seed)
    if not buffer.capacity:
        raise NotApplicableError("it does not keep rows")
    return buffer


def _take(buffer: Buffer, batch: int) -> BatchSelection:
    return buffer.take(batch, buffer.needed(batch) - buffer.arrived)


def _drawn(buffer: Buffer, first: int, count: int) -> Batch:
    """Return the rows and slots of some batches."""
    draws = [_take(buffer, batch) for batch in range(first, first + count)]
    found = {f"rows of batch {first + n}": draw.rows for n, draw in enumerate(draws)}
    return found | {f"slots of batch {first + n}": draw.drawn for n, draw in enumerate(draws)}


def _needs(subject: Subject) -> None:
    buffer = _begun(subject)
    needed = [buffer.needed(batch) for batch in range(_BATCHES)]
    expect(all(type(number) is int for number in needed), "needed() must return an int")
    expect(
        all(a <= b for a, b in itertools.pairwise(needed)),
        f"needed() decreases: {needed}",
    )
    expect(needed[0] > 0, "no row is needed for the first batch")
    expect(
        buffer.total == needed[-1], f"total is {buffer.total}, but needed() ends at {needed[-1]}"
    )
    backward = [buffer.needed(batch) for batch in reversed(range(_BATCHES))]
    expect(backward[::-1] == needed, "needed() depends on the order in which batches are queried")


def _needs_the_same(subject: Subject) -> None:
    buffer = _keeping(subject)
    before = [buffer.needed(batch) for batch in range(_BATCHES)]
    _drawn(buffer, 0, _BATCHES)
    after = [buffer.needed(batch) for batch in range(_BATCHES)]
    expect(before == after, "needed() is different after batches were drawn")
    other = [_begun(subject, seed=6).needed(batch) for batch in range(_BATCHES)]
    expect(before == other, "needed() depends on the seed")


def _draws(subject: Subject) -> None:
    buffer = _keeping(subject)
    for batch in range(_BATCHES):
        kept, arrived = set(buffer.kept.tolist()), buffer.arrived
        draw = _take(buffer, batch)
        kept.update(range(arrived, buffer.arrived))
        expect(
            draw.rows.shape == (_BATCH,) and draw.rows.max() < buffer.arrived,
            f"batch {batch} holds rows {draw.rows.tolist()} of {buffer.arrived} that have arrived",
        )
        drawn = set(draw.rows.tolist())
        expect(
            drawn <= kept, f"batch {batch} holds rows {sorted(drawn - kept)}, which were dropped"
        )
        left = buffer.kept.tolist()
        expect(len(set(left)) == len(left), f"after batch {batch} a row is in two slots")


def _repeats(subject: Subject) -> None:
    first = _drawn(_keeping(subject), 0, _BATCHES)
    again = _drawn(_keeping(subject), 0, _BATCHES)
    expect_equal(again, first, "a second run with the same seed draws differently")
    buffer = _keeping(subject)
    _drawn(buffer, 0, 7)
    buffer.begin(_BATCH, _BATCHES, _SEED)
    expect_equal(_drawn(buffer, 0, _BATCHES), first, "after a second begin() it draws differently")


def _continues(subject: Subject) -> None:
    whole = _keeping(subject)
    half = _BATCHES // 2
    _drawn(whole, 0, half)
    state = whole.state(half)
    expect(np.asarray(state).dtype.kind == "i", "state() must return whole numbers")
    state = np.array(state)
    rest = _drawn(whole, half, _BATCHES - half)
    resumed = _keeping(subject)
    resumed.restore(half, state)
    expect(resumed.arrived == state[0], "restore() does not set the number of arrived rows")
    expect_equal(
        _drawn(resumed, half, _BATCHES - half), rest, "after restore() it draws differently"
    )


def _steps_back(subject: Subject) -> None:
    buffer = _keeping(subject)
    half = _BATCHES // 2
    _drawn(buffer, 0, half)
    before = np.array(buffer.state(half))
    wanted = _drawn(buffer, half, 1)
    undone = np.array(buffer.state(half))
    expect_equal(
        {"state": undone},
        {"state": before},
        "the state before the last batch, which a checkpoint needs, differs from what it was then",
    )
    other = _keeping(subject)
    other.restore(half, undone)
    expect_equal(
        _drawn(other, half, 1), wanted, "restored to before the last batch, it draws differently"
    )


def _refuses(subject: Subject) -> None:
    buffer = _keeping(subject)
    for state, what in (
        (np.zeros(2 * buffer.capacity + 2, np.int64), "the state of a larger buffer"),
        (np.full(2 * buffer.capacity + 1, 7, np.int64), "a state of rows that have not arrived"),
    ):
        try:
            buffer.restore(3, state)
        except ValueError:
            continue
        raise AssertionError(f"restore() accepted {what}; it must raise ValueError")


def _quiet(subject: Subject) -> None:
    with unchanged(subject.before):
        buffer = _begun(subject)
        if buffer.capacity:
            _drawn(buffer, 0, _BATCHES)
        else:
            buffer.needed(_BATCHES - 1)


CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    "needs more rows from batch to batch": _needs,
    "needs rows that depend only on its options": _needs_the_same,
    "draws rows that it keeps": _draws,
    "draws the same again": _repeats,
    "continues from a state": _continues,
    "steps back by one batch": _steps_back,
    "refuses states of other buffers": _refuses,
    "leaves its process as it was": _quiet,
}
