"""Which rows batches hold: all buffers against plain dictionaries of what should be kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core import Buffer
from physx_core.errors import ConfigError, UnknownOptionError, UsageError
from physx_core.plugins import create, resolve

MIXING = ("fifo", "reservoir", "window")
DROPPED_AFTER = {"fifo": lambda views: views, "reservoir": lambda views: 1, "window": lambda _: 0}
"""Least number of uses of a row that is dropped, by the number of views."""


def make(name, batch_size, batch_nb, seed=0, **options):
    buffer = create("buffer", f"physx/{name}", options)
    buffer.begin(batch_size, batch_nb, seed)
    return buffer


@st.composite
def runs(draw):
    """Return a buffer's name, its options, and the sizes of a run that they allow."""
    name = draw(st.sampled_from(MIXING))
    batch_size, views = draw(st.integers(1, 6)), draw(st.integers(1, 5))
    watermark = draw(st.integers(batch_size, 3 * batch_size))
    least = watermark * (views if name == "fifo" else 1)
    options = {
        "capacity": least + draw(st.integers(0, 12)),
        "watermark": watermark,
        "views": views,
    }
    return name, options, batch_size, draw(st.integers(1, 40)), draw(st.integers(0, 2**32))


@given(runs(), st.sets(st.integers(0, 40)))
def test_buffers_keep_and_draw_what_the_model_says(run, resumed_at):
    name, options, batch_size, batch_nb, seed = run
    capacity, views, watermark = (options[key] for key in ("capacity", "views", "watermark"))
    buffer = make(name, batch_size, batch_nb, seed, **options)
    kept, uses, arrived = {}, {}, 0  # slot to row, row to number of uses, number of rows
    for batch in range(batch_nb):
        if batch in resumed_at:
            state = buffer.state(batch)
            buffer = make(name, batch_size, batch_nb, seed, **options)
            buffer.restore(batch, state)
        needed = buffer.needed(batch)
        assert needed >= max(arrived, watermark)
        before, state = set(kept.values()), buffer.state(batch)
        draw = buffer.take(batch, needed - arrived)
        assert np.array_equal(buffer.state(batch), state)
        for slot in draw.placed.tolist():
            kept[slot], uses[arrived] = arrived, 0
            arrived += 1
        dropped, held = before - set(kept.values()), set(kept.values())
        assert len(kept) <= capacity
        assert arrived == buffer.arrived == needed
        assert draw.rows.tolist() == [kept[slot] for slot in draw.drawn.tolist()]
        assert len(draw.rows) == batch_size
        if name == "window":
            assert held == set(range(max(0, arrived - capacity), arrived))
        if name == "reservoir":
            assert len(held) == min(arrived, capacity)
        assert all(uses[row] >= DROPPED_AFTER[name](views) for row in dropped)
        assert name == "fifo" or len(set(draw.rows.tolist())) == batch_size
        for row in draw.rows.tolist():
            uses[row] += 1
        if name != "fifo":
            assert set(buffer.kept.tolist()) == held
        assert buffer.uses[list(kept)].tolist() == [uses[row] for row in kept.values()]
        assert name != "fifo" or max(uses.values()) <= views
    needed = max(watermark, -(-batch_nb * batch_size // views))
    if batch_nb * batch_size >= views * watermark:
        assert arrived == needed
        assert name != "fifo" or sum(uses.values()) == batch_nb * batch_size


@given(runs(), st.integers(1, 40))
def test_a_run_that_is_made_longer_continues_with_the_rows_that_are_there(run, more):
    name, options, batch_size, batch_nb, seed = run
    short = make(name, batch_size, batch_nb, seed, **options)
    arrived = 0
    for batch in range(batch_nb):
        short.take(batch, short.needed(batch) - arrived)
        arrived = short.needed(batch)
    longer = make(name, batch_size, batch_nb + more, seed, **options)
    longer.restore(batch_nb, short.state(batch_nb))
    for batch in range(batch_nb, batch_nb + more):
        count = longer.needed(batch) - longer.arrived
        assert count >= 0
        assert longer.take(batch, count).rows.max() < longer.arrived


@pytest.mark.parametrize("name", MIXING)
def test_what_is_drawn_depends_on_seed_and_counts_only(name):
    def run(seed):
        buffer = make(name, 4, 50, seed, capacity=40, watermark=12, views=2)
        return [buffer.take(n, buffer.needed(n) - buffer.arrived).rows.tolist() for n in range(50)]

    assert run(1) == run(1)
    assert run(1) != run(2)


@pytest.mark.parametrize("name", ["reservoir", "window"])
def test_all_rows_that_are_held_are_drawn_alike(name):
    buffer = make(name, 8, 2000, capacity=64, watermark=64, views=1000)
    counts = np.zeros(64)
    for batch in range(500):
        counts[buffer.take(batch, buffer.needed(batch) - buffer.arrived).drawn] += 1
    assert abs(counts - 500 * 8 / 64).max() < 40  # five standard deviations


def test_a_reservoir_keeps_rows_of_all_ages_and_a_window_the_newest():
    ages = {}
    for name in ("reservoir", "window"):
        buffer = make(name, 10, 400, capacity=200, watermark=50, views=2)
        for batch in range(300):
            buffer.take(batch, buffer.needed(batch) - buffer.arrived)
        ages[name] = buffer.arrived - buffer.rows
    assert ages["window"].max() == 200
    assert ages["reservoir"].max() > 400
    assert np.median(ages["reservoir"]) < 300


def test_a_stream_needs_the_rows_of_its_batches_and_keeps_none():
    buffer = make("stream", 16, 10)
    assert [buffer.needed(batch) for batch in range(3)] == [16, 32, 48]
    assert buffer.capacity == 0


def test_rows_arrive_in_proportion_to_views_and_end_with_what_the_batches_need():
    buffer = make("reservoir", 10, 100, capacity=300, watermark=100, views=4)
    assert [buffer.needed(n) for n in (0, 1, 2, 40, 60, 99)] == [100, 102, 105, 200, 250, 250]


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("reservoir", {"watermark": 4}, "at least the batch size, 8"),
        ("reservoir", {"capacity": 10, "watermark": 11}, "capacity is 10, but"),
        ("fifo", {"capacity": 30, "watermark": 10, "views": 4}, "up to 40 rows are kept"),
        ("window", {"views": 0}, "views is 0 but must be"),
        ("window", {"capacity": True}, "capacity is True but must be"),
        ("window", {"capacity": 4}, "Enlarge capacity"),
    ],
)
def test_options_that_do_not_fit_are_named(name, options, text):
    with pytest.raises(ConfigError, match=text):
        make(name, 8, 100, **options)


def test_an_unknown_option_is_an_error_that_lists_the_others():
    with pytest.raises(UnknownOptionError, match=r'"size".*capacity'):
        make("window", 8, 100, size=3)


def test_a_state_of_other_options_is_refused():
    state = make("window", 4, 10, capacity=20).state(0)
    for change in ({"capacity": 30}, {}):
        buffer = make("window", 4, 10, **{"capacity": 20, **change})
        wrong = state if change else state - 5
        with pytest.raises(ValueError, match="other options|have not arrived"):
            buffer.restore(0, wrong)


class Faulty(Buffer):
    capacity = 4

    def needed(self, batch):
        return 4

    def place(self, count, random):
        return np.arange(self.first, self.first + count)

    def draw(self, random):
        return np.full(self.batch_size, self.slot)


@pytest.mark.parametrize(
    ("first", "slot", "text"),
    [(1, 0, r"Faulty\.place"), (0, 4, r"Faulty\.draw"), (0, 3, "a slot without a row")],
)
def test_a_faulty_buffer_of_a_plugin_is_named(first, slot, text):
    buffer = resolve("buffer", Faulty)()
    buffer.begin(2, 1, 0)
    buffer.first, buffer.slot = first, slot
    with pytest.raises(UsageError, match=text):
        buffer.take(0, 4 if first else 3)
