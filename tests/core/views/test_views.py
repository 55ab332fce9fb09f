"""Views against the simplest model: lists of rows by trajectory."""

import itertools
import multiprocessing
import os
import pickle
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from sizes import trials

from physx_core import Dataset, View
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import memory
from physx_core.errors import ConfigError, DatasetError
from physx_core.views import sources
from physx_core.views.folds import folds_of

MANY = 10**12


@pytest.fixture(autouse=True)
def nothing_reaches_the_disk(monkeypatch):
    for name in ("fsync", "fdatasync"):  # nothing here depends on that
        monkeypatch.setattr(os, name, lambda descriptor: None)


def episodes(lengths):
    """Rows of episodes by trajectory: field x tells episode and step."""
    return [np.stack([np.full(n, e), np.arange(n)], 1) for e, n in enumerate(lengths)]


def store(folder, trajectories, first=0):
    """Store independent episodes, each with a parameter p, a tenth of its number."""
    make = Dataset.open if (folder / "dataset.json").exists() else Dataset.create
    options = {"writable": True} if make == Dataset.open else {}
    new = dict(enumerate(trajectories[first:], first))
    x = np.concatenate([*new.values()])
    rows = {
        "x": x.astype(float), "label": x[:, 0] % 3, "env_id": np.zeros(len(x), int),
        "episode": x[:, 0], "step": x[:, 1],
    }  # fmt: skip
    records = [
        EpisodeRecord(
            episode=number, rows=len(one), parameters={"p": number / 10},
            status=EpisodeStatus.CUT if number == 3 else EpisodeStatus.FINISHED,
        )
        for number, one in new.items()
    ]  # fmt: skip
    with make(folder, **options) as dataset:
        dataset.append_episodes("training", rows, records)


def store_streams(folder, trajectories, instances):
    """Store trajectories as those of streams, whose rows take turns."""
    streams = [[] for _ in range(instances)]
    for number, x in enumerate(trajectories):
        streams[number % instances].append(x)
    joined = [np.concatenate(each) if each else np.zeros((0, 2)) for each in streams]
    rows = [
        (place + 1, number, x)
        for number in range(max(map(len, joined)))
        for place, each in enumerate(joined)
        for x in each[number : number + 1]
    ]
    with Dataset.create(folder) as dataset:
        dataset.append(
            "training",
            {
                "x": np.array([x for *_, x in rows], float),
                "label": [int(x[0]) % 3 for *_, x in rows],
                "env_id": [place for place, *_ in rows], "step": [step for _, step, _ in rows],
                "episode": [int(x[0]) for *_, x in rows],
            },
        )  # fmt: skip


class Model:
    """What a view is, in lists."""

    def __init__(self, view, trajectories, folds):
        self.view = view
        kept = [
            x for x, fold in zip(trajectories, folds, strict=True)
            if fold not in view.held.values()
        ]  # fmt: skip
        offsets = [o for window in view.windows.values() for o in window.at] or [0]
        low, high = min(0, *offsets), max(0, *offsets)
        if view.edges == "pad":
            low = high = 0
        self.items = [(x, at) for x in kept for at in range(-low, len(x) - high, view.stride)]

    def item(self, number):
        x, at = self.items[number]
        if not self.view.windows:
            return {"x": x[at]}
        found = {}
        for name, window in self.view.windows.items():
            places = [at + offset for offset in window.at]
            inside = [min(max(place, 0), len(x) - 1) for place in places]
            values = x[inside][0] if window.is_single else x[inside]
            found[name] = values
            if self.view.edges == "pad":
                pad = np.array([p != q for p, q in zip(places, inside, strict=True)])
                found[f"{name}_is_pad"] = pad[0] if window.is_single else pad
        return found


OFFSETS = st.lists(st.integers(-3, 3), min_size=1, max_size=4)
WINDOWS = st.dictionaries(
    st.sampled_from(["past", "next", "now"]),
    st.tuples(st.just("x"), OFFSETS | st.integers(-2, 2)),
    max_size=2,
)


@pytest.mark.slow
@pytest.mark.timeout(trials(7200, 600))
@settings(database=None, deadline=None, max_examples=trials(10_000, 25))
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=14), window=WINDOWS,
    stride=st.integers(1, 3), edges=st.sampled_from(["inside", "pad"]),
    instances=st.integers(0, 3), folds=st.integers(2, 6), held=st.booleans(),
    size=st.integers(1, 7), seed=st.integers(0, 99), free=st.sampled_from([0, MANY]),
    order=st.sampled_from([None, "exact", "blocks"]),
)  # fmt: skip
def test_views_have_the_items_of_the_model(
    lengths, window, stride, edges, instances, folds, held, size, seed, order, free
):
    trajectories = episodes(lengths)
    view = View(
        window=window, stride=stride, edges=edges, folds=folds, order=order,
        hold_back=held, test_fold=1 if held else None, fold_seed=seed,
    )  # fmt: skip
    with TemporaryDirectory() as name, mock.patch.object(memory, "available_memory", lambda: free):
        folder = Path(name, "data")
        if instances:
            store_streams(folder, trajectories, instances)
            trajectories.sort(key=lambda x: first_row(folder, x))
        else:
            store(folder, trajectories)
        if held and len(lengths) < folds:
            return  # pieces: see below
        numbers, campaign = np.arange(len(lengths)), np.full(len(lengths), -1 if instances else 0)
        of = folds_of(campaign, numbers, folds, seed)
        model = Model(view, trajectories, of.tolist())
        if instances and not (window or held) and stride == 1:  # all rows, as they were stored
            model.items.sort(key=lambda item: first_row(folder, item[0][item[1] :]))
        if not model.items:
            with pytest.raises((DatasetError, ConfigError)):
                view.open(size, seed, data=folder)
            return
        with view.open(size, seed, data=folder, fields=None if window else ["x"]) as batches:
            count = len(model.items)
            assert batches.num_items == count and len(batches) == -(-count // size)
            expected = [model.item(number) for number in range(count)]
            nbytes = batches._sources[0].rows.row_nbytes
            for epoch in range(2):
                key = shuffling.key_of(seed, epoch, 0, 0)
                kind = order or "exact"
                drawn = shuffling.make_order(kind, count, nbytes, key).items(0, count).tolist()
                assert sorted(drawn) == list(range(count))
                for place in range(len(batches)):
                    batch = batches[epoch * len(batches) + place]
                    wanted = drawn[place * size : (place + 1) * size]
                    for field, values in batch.items():
                        assert_array_equal(values, [expected[item][field] for item in wanted])


def first_row(folder, x):
    with Dataset.open(folder) as dataset:
        return np.flatnonzero((dataset["training"]["x"][:] == x[0]).all(axis=1))[0]


# Folds ------------------------------------------------------------------------------------------


@pytest.mark.reported("nnUNet#2431", about="other folds, and the same ones when samples are added")
def test_more_episodes_never_move_one_between_folds():
    numbers = np.arange(1000)
    whole = folds_of(np.zeros(1000, int), numbers, 5, 3)
    for count in (1, 4, 5, 77, 999):
        some = folds_of(np.zeros(count, int), numbers[:count], 5, 3)
        assert_array_equal(some, whole[:count])
    assert set(Counter(whole.tolist()).values()) == {200}
    alone = folds_of(np.zeros(3, int), np.array([999, 5, 500]), 5, 3)
    assert_array_equal(alone, whole[[999, 5, 500]])
    assert not np.array_equal(folds_of(np.ones(1000, int), numbers, 5, 3), whole)
    assert not np.array_equal(folds_of(np.zeros(1000, int), numbers, 5, 4), whole)


def numbers_in(batches):
    return {int(e) for batch in batches for e in batch["x"][:, 0]}


@pytest.mark.reported(
    "neuracore#155", about="parts of one trajectory are in training and validation"
)
def test_parts_share_no_episode_and_have_all(tmp_path):
    store(tmp_path, episodes([3] * 40))
    found = []
    for fold in range(4):
        view = View(folds=4, fold=fold, test_fold=(fold + 1) % 4)
        parts = [numbers_in(view.open(7, data=tmp_path, part=part))
                 for part in ("training", "validation", "test")]  # fmt: skip
        assert [len(part) for part in parts] == [20, 10, 10]
        assert set().union(*parts) == set(range(40))
        found.append(parts[1])
        assert parts[2] == numbers_in(
            View(folds=4, fold=(fold + 1) % 4).open(7, data=tmp_path, part="validation")
        )
    assert set().union(*found) == set(range(40))


def test_of_few_streams_the_end_is_held_back(tmp_path):
    store_streams(tmp_path, episodes([50, 50]), 2)
    view = View(folds=5, fold=0, test_fold=1, window={"x": ("x", [0, 1])})
    steps = {
        part: {(int(e), int(s)) for batch in view.open(8, data=tmp_path, part=part)
               for window in batch["x"] for e, s in window}
        for part in ("training", "validation", "test")
    }  # fmt: skip
    for part, inside in (("training", range(30)), ("test", range(30, 40)),
                         ("validation", range(40, 50))):  # fmt: skip
        assert steps[part] == {(e, s) for e in range(2) for s in inside}


def test_rows_without_episodes_are_held_back_in_blocks(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        dataset.append("training", {"n": np.arange(1600)})
    view = View(folds=5, fold=2)
    held = np.concatenate([b["n"] for b in view.open(10, data=tmp_path, part="validation")])
    rest = np.concatenate([b["n"] for b in view.open(10, data=tmp_path)])
    assert len(held) == 320 and sorted([*held, *rest]) == list(range(1600))
    assert set(Counter(held // 16).values()) == {16}


# Which episodes ---------------------------------------------------------------------------------


def few(values):
    """Choose episodes by a parameter."""
    assert values["rows"].shape == values["p"].shape
    return values["p"] < 0.35


def no_flags(values):
    return values["p"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"episodes": {"p": [0.45, 0.7]}}, {5, 6, 7}),
        ({"episodes": {"episode": [2, 4], "status": "finished"}}, {2, 4}),
        ({"episodes": {"status": "cut"}}, {3}),
        ({"where": f"{__file__}:few"}, {0, 1, 2, 3}),
        ({"where": f"{__file__}:few", "episodes": {"episode": [2, 9]}}, {2, 3}),
    ],
)
def test_episodes_are_chosen_by_what_they_are(tmp_path, options, expected):
    store(tmp_path, episodes([3] * 10))
    assert numbers_in(View(**options).open(4, data=tmp_path)) == expected


def test_wrong_choices_are_named(tmp_path):
    store(tmp_path / "a", episodes([3] * 10))
    store_streams(tmp_path / "b", episodes([3] * 10), 2)
    for options, data, message in (
        ({"episodes": {"q": [0, 1]}}, "a", 'no field "q"'),
        ({"episodes": {"p": [5, 6]}}, "a", "nothing to read for the part"),
        ({"episodes": {"p": [5, 6]}}, "b", "not recorded"),
        ({"where": f"{__file__}:no_flags"}, "a", "not one boolean for each"),
        ({"window": {"w": ("y", [0])}}, "a", 'no field "y"'),
        ({"weights": "class:x"}, "a", "several values"),
        ({"window": {"w": ("x", [0, 9])}}, "a", "no window fits"),
    ):
        with pytest.raises((ConfigError, DatasetError), match=message):
            View(**options).open(4, data=tmp_path / data)[0]
    with pytest.raises(ConfigError, match="set View.hold_back"):
        View(hold_back=False).open(4, data=tmp_path / "a", part="validation")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": {"w": "x"}}, "w is 'x' but must be a field and its offsets"),
        ({"window": {"w": ("x", [])}}, "offsets"),
        ({"window": {"w": ("x", [0.5])}}, "offsets"),
        ({"fold": 5}, "of 5 folds the last is 4"),
        ({"fold": 1, "test_fold": 1}, "are the same"),
        ({"folds": 1}, "at least 2"),
        ({"weights": "rows"}, "must be"),
        ({"sources": {"a": 0.0}}, "not positive"),
        ({"episodes": {"p": 1}}, "smallest and largest"),
        ({"episodes": {"status": "failed"}}, "finished"),
        ({"order": "random"}, "exact"),
        ({"stride": 0}, "at least 1"),
    ],
)
def test_mistakes_in_a_view_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        View(**options)


# Sources and weights ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(trials(7200, 600))
@settings(database=None, deadline=None, max_examples=trials(10_000, 25))
@given(
    shares=st.lists(st.integers(1, 9), min_size=2, max_size=4), seed=st.integers(0, 9),
    epoch=st.sampled_from(["first", "all"]), size=st.integers(1, 40),
)  # fmt: skip
@pytest.mark.reported("lerobot#1158", "webdataset#244", about="datasets are mixed in shares")
def test_each_batch_has_its_share_of_each_source(shares, seed, epoch, size):
    with TemporaryDirectory() as name:
        folders = [str(Path(name, str(k))) for k in range(len(shares))]
        counts = [30 + 20 * k for k in range(len(shares))]
        for folder, count in zip(folders, counts, strict=True):
            with Dataset.create(folder) as dataset:
                n = np.arange(count)
                dataset.append("training", {"n": n, "of": np.full(count, folders.index(folder))})
        sources = dict(zip(folders, map(float, shares), strict=True))
        view = View(sources=sources, epoch=epoch, hold_back=False)
        with view.open(size, seed) as batches:
            pairs = np.concatenate([np.stack([b["of"], b["n"]], 1) for b in batches])
        total = len(pairs)
        for k, (share, count) in enumerate(zip(shares, counts, strict=True)):
            of = share / sum(shares)
            for start in range(0, total, size):  # of any consecutive slots
                some = pairs[start : start + size, 0]
                assert abs((some == k).sum() - of * len(some)) < len(shares) + 1
            mine = pairs[pairs[:, 0] == k, 1]
            for first in range(0, len(mine), count):  # each pass has each at most once
                one = mine[first : first + count]
                assert len(set(one.tolist())) == len(one)
            if epoch == "all":
                assert set(mine.tolist()) == set(range(count))
        exact = [count * sum(shares) / share for count, share in zip(counts, shares, strict=True)]
        ends = min(exact) if epoch == "first" else max(exact)
        assert abs(total - ends) <= 2 + 0.05 * ends


@pytest.mark.slow
@pytest.mark.timeout(trials(7200, 600))
@settings(database=None, deadline=None, max_examples=trials(10_000, 25))
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=14), window=WINDOWS,
    kind=st.sampled_from(["episode", "class:label", "field:step"]),
    folds=st.integers(2, 6), held=st.booleans(), size=st.integers(1, 7), seed=st.integers(0, 99),
)  # fmt: skip
def test_weighted_items_come_in_proportion(lengths, window, kind, folds, held, size, seed):
    trajectories, held = episodes(lengths), held and len(lengths) >= folds
    view = View(window=window, weights=kind, folds=folds, hold_back=held, fold_seed=seed)
    numbers = np.arange(len(lengths))
    kept = folds_of(np.zeros(len(lengths), int), numbers, folds, seed).tolist() if held else []
    model = Model(view, trajectories, kept or [-1] * len(lengths))
    items = [(int(x[at][0]), int(x[at][1])) for x, at in model.items]
    same = Counter(episode if kind == "episode" else episode % 3 for episode, _ in items)
    weights = [
        step if kind == "field:step" else 1 / same[episode if kind == "episode" else episode % 3]
        for episode, step in items
    ]  # fmt: skip
    with TemporaryDirectory() as name:
        store(Path(name), trajectories)
        if not sum(weights):
            with pytest.raises((DatasetError, ConfigError)):
                view.open(size, seed, data=name)[0]
            return
        with view.open(size, seed, data=name) as batches:
            found: Counter = Counter()
            for number in range(len(batches)):
                (rows,) = batches.rows(number)
                found.update(rows.tolist())
    begins = np.cumsum([0, *lengths])
    for (episode, step), weight in zip(items, weights, strict=True):
        times = found.pop(int(begins[episode]) + step, 0)
        assert abs(times - len(items) * weight / sum(weights)) < 1 + 1e-9
    assert not found


# Purity -----------------------------------------------------------------------------------------


def equal(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n]) for n in one)


def read(batches, number, queue):
    queue.put(batches[number]["x"].tolist())


@pytest.mark.processes
@pytest.mark.parametrize("window", [{}, {"past": ("x", [-1, 0])}])
@pytest.mark.parametrize("order", ["exact", "blocks"])
def test_a_batch_depends_on_its_number_alone(tmp_path, monkeypatch, window, order):
    monkeypatch.setattr(shuffling, "_BLOCK", 100)
    monkeypatch.setattr(shuffling, "_WINDOW", 3)
    store(tmp_path, episodes([5, 8, 13] * 10))
    view = View(window=window, order=order, fold=1)
    with view.open(16, 7, data=tmp_path) as batches:
        numbers = range(3 * len(batches))
        whole = [batches[number] for number in numbers]
        for number in reversed(numbers):
            assert equal(batches[number], whole[number])
        monkeypatch.setattr(memory, "available_memory", lambda: 0)
        assert equal(pickle.loads(pickle.dumps(batches))[20], whole[20])  # noqa: S301
        store(tmp_path, episodes([5, 8, 13] * 10 + [7] * 20), first=30)
        with view.open(16, 7, data=tmp_path, snapshot=batches.snapshot) as again:
            assert again.digest == batches.digest
            assert all(equal(again[number], whole[number]) for number in numbers)
        with view.open(16, 7, data=tmp_path) as more:
            assert more.num_items > batches.num_items and more.digest != batches.digest


def record(number):
    return EpisodeRecord(episode=number, rows=6, parameters={"p": number / 10})


def test_rows_that_come_between_change_nothing_with_a_snapshot(tmp_path):
    x = episodes([6] * 10)
    store(tmp_path, x[:5])
    with Dataset.open(tmp_path, writable=True) as dataset:
        rows = {"x": x[7].astype(float), "label": np.zeros(6, int), "env_id": np.zeros(6, int),
                "episode": np.full(6, 7), "step": np.arange(6)}  # fmt: skip
        dataset.append_episodes("training", rows, [record(7)])
    view = View(window={"x": ("x", [0, 1])}, fold=0, episodes={"p": [0, 0.7]})
    with view.open(4, data=tmp_path) as batches:
        whole, snapshot = [*batches], batches.snapshot
    with Dataset.open(tmp_path, writable=True) as dataset:
        rows |= {"x": x[5].astype(float), "episode": np.full(6, 5)}
        dataset.append_episodes("training", rows, [record(5)])
    with view.open(4, data=tmp_path, snapshot=snapshot) as again:
        assert all(equal(*pair) for pair in zip(again, whole, strict=True))
    for lost in ((900, 90, 0), (6, 1, 0), (6, 0, 0)):
        with pytest.raises(DatasetError, match="no longer there as they were"):
            view.open(4, data=tmp_path, snapshot={"": lost})
    with pytest.raises(ConfigError, match="no rows of the source"):
        view.open(4, data=tmp_path, snapshot={"elsewhere": snapshot[""]})


def test_folds_of_one_stream_are_its_pieces(tmp_path):
    store_streams(tmp_path, episodes([53]), 1)
    found = []
    for fold in range(5):
        view = View(folds=5, fold=fold, test_fold=(fold + 2) % 5)
        steps = [
            sorted(int(s) for batch in view.open(8, data=tmp_path, part=part)
                   for s in batch["x"][:, 1])
            for part in ("training", "validation", "test")
        ]  # fmt: skip
        assert sorted(itertools.chain(*steps)) == list(range(53))
        assert steps[1] == list(range(steps[1][0], steps[1][-1] + 1))
        found += steps[1]
    assert sorted(found) == list(range(53))


@pytest.mark.processes
@pytest.mark.parametrize("window", [{}, {"x": ("x", [-1, 0])}])
@pytest.mark.reported("pytorch#73603", about="the order of samples depends on the workers")
def test_other_processes_read_the_same(tmp_path, monkeypatch, window):
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    store(tmp_path, episodes([9] * 30))
    with View(window=window, order="blocks").open(16, 7, data=tmp_path) as batches:
        expected = batches[5]["x"].tolist()
        queue = multiprocessing.get_context("fork").Queue()
        forked = multiprocessing.get_context("fork").Process(target=read, args=(batches, 5, queue))
        forked.start()
        assert queue.get(timeout=60) == expected
        forked.join()
        code = "import pickle, sys; print(pickle.load(sys.stdin.buffer)[5]['x'].tolist())"
        words, given = [sys.executable, "-c", code], pickle.dumps(batches)
        assert (
            str(expected)
            == subprocess.check_output(words, input=given, text=False).decode().strip()
        )


def test_normalization_is_that_of_the_part(tmp_path):
    store(tmp_path, episodes([4, 6] * 10))
    view = View(window={"past": ("x", [-1, 0])}, fold=0)
    with view.open(4, data=tmp_path) as batches:
        found = batches.normalization()
        rows = batches.all_rows()
    with Dataset.open(tmp_path) as dataset:
        x = dataset["training"]["x"][rows]
    assert found.keys() == {"past"}
    np.testing.assert_allclose(found["past"].mean, x.mean(axis=0))
    np.testing.assert_allclose(found["past"].std, x.std(axis=0))


def test_folds_of_recorded_episodes_are_found_without_their_rows(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        rows = {"x": np.arange(40.0), "step": np.tile(np.arange(4), 10)}
        known = [EpisodeRecord(episode=k, rows=4) for k in range(10)]
        dataset.append_episodes("training", rows, known)
    (tmp_path / "data" / "run_training_step_0.h5").unlink()
    with View(fold=0).open(4, data=tmp_path / "data") as batches:
        assert batches.num_items == 32


def test_the_picture_of_views_is_of_those_on_the_page():
    docs = Path(__file__).parents[3] / "docs"
    script, page = docs / "nine_views.py", docs / "views.md"
    drawn = re.findall(r'^    "(.+)": (View\(.*\)),$', script.read_text("utf-8"), re.M)
    assert drawn == re.findall(r"^\| (.+) \| `(View\(.*\))` \|$", page.read_text("utf-8"), re.M)
    assert len(drawn) == 9


def test_rows_without_episodes_stay_in_their_part_as_others_are_added(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "_SAME_SIZE", 10)  # blocks double after 160 rows
    held = []
    for count in (90, 400, 3000):
        folder = tmp_path / str(count)
        with Dataset.create(folder) as dataset:
            dataset.append("training", {"x": np.arange(count, dtype=float)})
        parts = [View().open(7, data=folder, part=p).all_rows() for p in ("training", "validation")]
        assert_array_equal(np.sort(np.concatenate(parts)), np.arange(count))
        held.append(parts[1])
        for former, now in itertools.pairwise(held):  # the last block may have grown
            assert set(former) == {row for row in now if row < former[-1] + 1}
    assert len(held[-1]) == pytest.approx(600, rel=0.2)
    with View().open(7, data=folder) as batches:
        assert batches.division == ["41 of 52 blocks of rows"]
