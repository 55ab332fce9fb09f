"""Pasts: the states and answers from which instances go on in a later run."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.net import Kind, encode, pack
from physx_core.workers.journal import Journal
from physx_core.workers.pasts import Past, unpack
from physx_core.workers.pasts import pack as pack_pasts

EVENTS = st.lists(st.sampled_from(["row", "answer", "state", "batch", "die"]), max_size=60)


class Kept:
    """The services and parameters of a run; they keep saved ones only."""

    def __init__(self):
        self.saved = {}

    def save_parameters(self, instance_id, values):
        self.saved[instance_id] = values

    def load_parameters(self, instance_id):
        return self.saved.get(instance_id, {})

    def waiting(self, instance_id):
        return -1, {}


def journal_of(kept, former=None, limit=1e9):
    return Journal(1, limit, kept, kept, former, keeps=True)


def answer(journal, told):
    """Tell a stream the answer to its next request for a prediction."""
    kind = Kind.ANSWER if told[0] else Kind.REFUSAL
    message = pack(kind, told[1], journal.answers + 1)
    journal.record(message, is_prediction=True)


@settings(max_examples=size(300, 60), deadline=None)
@given(EVENTS, st.integers(0, 2))
def test_a_later_run_is_told_all_answers_since_the_newest_state_that_counts(events, asked):
    """One stream against lists of all that happened."""
    kept = Kept()
    journal = journal_of(kept)
    created = [(True, encode(f"created {number}")) for number in range(asked)]
    for told in created:
        answer(journal, told)
    journal.end_creation()
    history, states, made = [], [(0, 0)], 0  # answers; rows and answers before each state
    checkpoint = None
    for event in events:
        if event == "row":
            made += 1
        elif event == "answer":
            history.append((len(history) % 3 != 0, encode(len(history))))
            answer(journal, history[-1])
        elif event == "state" and made > states[-1][0]:
            states.append((made, len(history)))
            kept.saved[1] = {"rows": made}
            journal.keep_state(Past(made, b"%d" % made))
        elif event == "batch":
            content = pack_pasts(made, {1: journal.at(made)})
            checkpoint = made, states[-1][0], history[states[-1][1] :], content
        elif event == "die" and checkpoint is not None:
            made, newest, since, content = checkpoint
            history = [*since]
            rows, former = unpack(content)
            assert (rows, former[1].rows) == (made, newest)
            assert former[1].state == (b"%d" % newest if newest else b"")
            kept = Kept()
            journal = journal_of(kept, former[1])
            for told in created:
                assert journal.tell() == told
                answer(journal, told)
            journal.end_creation()
            assert kept.saved == ({1: {"rows": newest}} if newest else {})
            for told in history:
                assert journal.tell() == told
                answer(journal, told)
            assert journal.tell() is None
            states = [(newest, 0)]


def test_a_stream_that_is_ahead_keeps_the_state_before_the_batch():
    journal = journal_of(Kept())
    journal.end_creation()
    for rows in (5, 10, 15, 20):
        journal.keep_state(Past(rows, b"state"))
    assert [journal.at(rows).rows for rows in (12, 14, 20)] == [10, 10, 20]


def test_answers_beyond_the_limit_are_given_up(caplog):
    journal = journal_of(Kept(), limit=300)
    journal.end_creation()
    for _ in range(3):
        answer(journal, (True, bytes(30)))
    assert journal.at(1).count == 3
    for _ in range(10):
        answer(journal, (True, bytes(30)))
    assert journal.at(1) is None
    journal.keep_state(Past(2, b"state"))
    assert journal.at(2) is None
    assert caplog.text.count("nor go on in a later run") == 1


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
    assert unpack(pack_pasts(9, {2: past})) == (9, {2: past})
