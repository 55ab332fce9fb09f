"""Pasts: the states and answers from which instances go on in a later run."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.net import encode
from physx_core.workers.pasts import Past, Pasts, pack, unpack

EVENTS = st.lists(st.sampled_from(["row", "answer", "state", "batch", "die"]), max_size=60)


class Kept:
    """The services of a run; they keep parameters only."""

    def __init__(self):
        self.saved = {}

    def save_parameters(self, instance_id, values):
        self.saved[instance_id] = values


@settings(max_examples=size(300, 60), deadline=None)
@given(EVENTS, st.integers(0, 2))
def test_a_later_run_is_told_all_answers_since_the_newest_state_that_counts(events, asked):
    """One instance against lists of all that happened."""
    services, pasts = Kept(), Pasts(1e9)
    created = [(True, encode(f"created {number}")) for number in range(asked)]
    for answer in created:
        pasts.answered(1, answer)
    pasts.created(1, services)
    history, states, made = [], [(0, 0)], 0  # answers; rows and answers before each state
    checkpoint = None
    for event in events:
        if event == "row":
            made += 1
        elif event == "answer":
            history.append((len(history) % 3 != 0, encode(len(history))))
            pasts.answered(1, history[-1])
        elif event == "state" and made > states[-1][0]:
            states.append((made, len(history)))
            pasts.note(1, Past(made, b"%d" % made, saved={"rows": made}))
        elif event == "batch":
            content = pack(made, pasts.at(lambda number, rows=made: rows, 1))
            checkpoint = made, states[-1][0], history[states[-1][1] :], content
        elif event == "die" and checkpoint is not None:
            made, newest, kept, content = checkpoint
            history = [*kept]
            rows, former = unpack(content)
            assert (rows, former[1].rows) == (made, newest)
            assert former[1].state == (b"%d" % newest if newest else b"")
            services, pasts = Kept(), Pasts(1e9, former)
            assert [pasts.tell(1) for _ in range(asked)] == created
            pasts.created(1, services)
            assert services.saved == ({1: {"rows": newest}} if newest else {})
            assert [pasts.tell(1) for _ in history] == history
            assert pasts.tell(1) is None
            states = [(newest, 0)]


def test_an_instance_that_is_ahead_keeps_the_state_before_the_batch():
    pasts = Pasts(1e9)
    pasts.created(1, Kept())
    for rows in (5, 10, 15, 20):
        pasts.note(1, Past(rows, b"state"))
    assert pasts.at(lambda number: 12, 1)[1].rows == 10
    assert pasts.at(lambda number: 14, 1)[1].rows == 10
    assert pasts.at(lambda number: 20, 1)[1].rows == 20


def test_answers_beyond_the_limit_are_given_up(caplog):
    pasts = Pasts(100)
    pasts.created(1, Kept())
    for _ in range(3):
        pasts.answered(1, (True, bytes(30)))
    assert pasts.at(lambda number: 1, 1)[1].count == 3
    for _ in range(3):
        pasts.answered(1, (True, bytes(30)))
    assert pasts.at(lambda number: 1, 1) is None
    pasts.note(1, Past(2, b"state"))
    assert pasts.at(lambda number: 2, 1) is None
    assert caplog.text.count("cannot be resumed within this epoch") == 1


@pytest.mark.parametrize(
    "plain",
    [
        b"",
        encode([1]),
        encode([1, {1: []}]),
        encode([1, [1]]),
        encode([1, {1: [*Past().pack()[:-1], [(1, b"")]]}]),
        encode([1, {1: [*Past().pack()[:-1], ["answer"]]}]),
        encode(["one", {"x": Past().pack()}]),
    ],
)
def test_what_is_no_past_is_refused(plain):
    with pytest.raises(ValueError):
        unpack(plain)


def test_pasts_are_the_same_after_packing():
    sets = {3: {"load": 0.5}}
    past = Past(4, b"state", 2, 1, sets, {"a": [1]}, ((False, b"x"),), [(True, b"y")], 1)
    assert unpack(pack(9, {2: past})) == (9, {2: past})
