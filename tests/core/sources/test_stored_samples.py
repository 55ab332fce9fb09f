"""Stored samples go through environments: sources, and trainings with load_samples."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    View,
)
from physx_core.cli import main
from physx_core.errors import (
    ConfigError,
    DatasetError,
    FieldsMismatchError,
    WrongSamplesError,
)

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "source_envs.py"
DOUBLING = f"{ENVS}:Doubling"
ALL = View(hold_back=False)
NETWORK = {"network_kwargs": {"net_fields": "x", "opt_fields": "y"}}


def environment(name="Doubling", **options):
    kwargs = {key: options.pop(key) for key in ("factor", "refuse") if key in options}
    options = {"as_tcp_ip_client": False, "seed": 1, **options}
    return EnvironmentConfig(f"{ENVS}:{name}", env_kwargs=kwargs, **options)


def through(**options):
    """The environment of a training that replays: it makes y three times the sum of x."""
    return environment(**{"factor": 3.0, "load_samples": True, **options})


@pytest.fixture
def source_dir():
    """A session with 40 samples to learn from and 10 to validate with."""
    for mode, number in (("training", 4), ("validation", 1)):
        DataGeneration(
            environment(num_clients=2),
            session_name="run",
            new_session=False,
            batch_nb=number,
            batch_size=10,
            mode=mode,
        ).execute()
    before = content("sessions/run/dataset")
    yield "sessions/run"
    assert content("sessions/run/dataset") == before  # it is never modified


def content(folder):
    paths = sorted(Path(folder).iterdir())
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def train(source_dir, config, name="training", *, data=None, **options):
    options = {"epoch_nb": 1, "batch_size": 7, "seed": 0, "session_name": name, **options}
    existing = DatasetConfig(existing_dir=source_dir, **(data or {}))
    training = Training(NetworkConfig("toy/linear", **NETWORK), existing, config, **options)
    training.execute()
    return training


def rows_of(place, mode="training"):
    with Dataset.open(place) as dataset:
        assert dataset.verify() == []
        return {name: view[:] for name, view in dataset[mode].items()}


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


# Sources ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("instances", [1, 3])
def test_each_row_is_made_of_its_stored_row_the_same_over_tcp(local, clients, instances):
    settings = {
        "num_clients": instances,
        "simulations_per_step": 2,
        "env_kwargs": {"factor": 2.0, "refuse": 4},
    }
    random = np.random.default_rng(0)
    with (
        local(DOUBLING, **settings) as ours,
        clients(DOUBLING, run_ahead=0, **settings) as theirs,
    ):
        for size in (1, 5, 2, 30):
            stored = {
                "x": random.random((size, 2)),
                "times": np.arange(size),
                "env_id": np.full(size, 9, np.int32),
                "episode": np.full(size, 8),
                "step": np.arange(size),
            }
            kept = {name: values.copy() for name, values in stored.items()}
            made = ours.batch(size, stored)
            assert np.array_equal(made["x"], kept["x"])
            assert np.array_equal(made["y"][:, 0], 2 * kept["x"].sum(axis=1))
            assert made["times"].tolist() == list(range(1, size + 1))
            assert made["seen"].tolist() == [[9, 8, step] for step in range(size)]
            same(theirs.batch(size, stored), made)
            same(stored, kept)
        same(theirs.batch(6), ours.batch(6))
        assert (theirs.batch(3)["seen"] == -1).all()


def test_a_sample_that_is_rejected_is_tried_again_with_the_same_stored_row(local):
    settings = {"env_kwargs": {"refuse": 2}, "record_wrong_samples": True}
    with local(DOUBLING, **settings) as source:
        stored = {"x": np.arange(8.0).reshape(4, 2), "times": np.zeros(4, int)}
        stored |= {name: np.arange(4) for name in ("env_id", "episode", "step")}
        made = source.batch(4, stored)
        wrong = source.pop_rejected()
    assert np.array_equal(made["x"], stored["x"])
    assert made["step"].tolist() == [0, 2, 4, 6]
    assert wrong["step"].tolist() == [1, 3, 5]
    assert wrong["seen"][:, 2].tolist() == [1, 2, 3]


# What a training makes of them ------------------------------------------------------------------


@pytest.mark.parametrize("shuffle", [True, False])
def test_what_is_made_is_learned_from_and_takes_the_samples_place(source_dir, shuffle):
    training = train(source_dir, through(num_clients=3), data={"shuffle": shuffle})
    before, after = rows_of(source_dir), rows_of("sessions/training")
    assert np.allclose(training.learner.network.weights[:, 0], [3, 3, 0])
    assert np.array_equal(after["x"], before["x"])
    assert np.allclose(after["y"], 3 * before["y"]) and (after["times"] == 1).all()
    for place, name in enumerate(("env_id", "episode", "step")):
        assert np.array_equal(after[name], before[name])
        assert np.array_equal(after["seen"][:, place], before[name])
    same(rows_of("sessions/training", "validation"), rows_of(source_dir, "validation"))
    with Dataset.open("sessions/training") as dataset:
        assert dataset.info["copied_from"] == "sessions/run/dataset"
        assert dataset.info["env_kwargs"] == {"factor": 3.0}


def test_samples_come_in_the_order_of_the_epoch(source_dir):
    orders = []

    class Watch(Training):
        def batch_end(self):
            orders[-1].extend(zip(*self.batch["seen"].T.tolist(), strict=True))

        def epoch_begin(self):
            orders.append([])

    for shuffle in (True, False):
        Watch(
            NetworkConfig("toy/linear", **NETWORK),
            DatasetConfig(existing_dir=source_dir, shuffle=shuffle),
            through(only_first_epoch=False),
            epoch_nb=2,
            batch_size=7,
            seed=0,
        ).execute()
    stored = rows_of(source_dir)
    columns = (stored[name].tolist() for name in ("env_id", "episode", "step"))
    written = list(zip(*columns, strict=True))
    assert orders[2] == orders[3] == written
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(written)
    assert len({str(order) for order in orders}) == 3


def test_later_epochs_read_the_copy_or_replay_it_again(source_dir):
    train(source_dir, through(), "once", epoch_nb=3)
    assert (rows_of("sessions/once")["times"] == 1).all()
    train(source_dir, through(only_first_epoch=False), "always", epoch_nb=3)
    assert (rows_of("sessions/always")["times"] == 3).all()


def test_batch_nb_cuts_an_epoch_and_the_pass_goes_on(source_dir):
    data = {"shuffle": False}
    train(source_dir, through(), "once", batch_nb=2, epoch_nb=3, data=data)
    assert np.flatnonzero(rows_of("sessions/once")["times"]).tolist() == list(range(14))
    always = through(only_first_epoch=False)
    train(source_dir, always, "always", batch_nb=4, epoch_nb=3, data=data)
    assert rows_of("sessions/always")["times"].tolist() == [2] * 40  # 7 + ... + 5, twice


@pytest.mark.slow
def test_the_same_over_tcp(source_dir, nothing_stays_behind):
    weights = []
    for over_tcp in (False, True):
        with pytest.raises(FieldsMismatchError, match="answer"):
            train(source_dir, through(name="Asking", as_tcp_ip_client=over_tcp), "other")
        config = through(
            refuse=5, num_clients=2, as_tcp_ip_client=over_tcp,
            only_first_epoch=False, record_wrong_samples=True,
        )  # fmt: skip
        training = train(source_dir, config, f"run_{over_tcp}", epoch_nb=2)
        weights.append(training.learner.network.weights)
    assert weights[0].tobytes() == weights[1].tobytes()
    for mode in ("training", "wrong"):
        same(rows_of("sessions/run_True", mode), rows_of("sessions/run_False", mode))
    assert len(rows_of("sessions/run_True", "wrong")["step"]) > 15
    assert sorted(path.name for path in Path("sessions").iterdir()) == [
        "run", "run_False", "run_True",
    ]  # fmt: skip


def test_normalization_is_that_of_the_rows_that_are_stored(source_dir):
    found = []

    class Watch(Training):
        def epoch_begin(self):
            found.append(self.learner.transformation.normalization["y"].mean.item())

    for session, once in (("once", True), ("always", False)):
        Watch(
            NetworkConfig("toy/linear", **NETWORK),
            DatasetConfig(existing_dir=source_dir, normalize=True),
            through(only_first_epoch=once),
            session_name=session,
            epoch_nb=3,
            batch_size=16,
        ).execute()
        with Dataset.open(f"sessions/{session}") as dataset:
            stored = dataset["training"]["y"][:]
            assert np.allclose(dataset.normalization["y"].mean, stored.mean(axis=0))
            assert np.allclose(dataset.normalization["y"].std, stored.std(axis=0))
    old = rows_of(source_dir)["y"].mean()
    assert np.allclose(found, 2 * [old, 3 * old, 3 * old])


def test_samples_that_are_held_back_are_not_replayed(source_dir):
    training = train(
        source_dir, through(), data={"mode": "validation", "view": View(folds=3, fold=0)}
    )
    assert rows_of("sessions/training", "validation")["times"].sum() == 10
    with Dataset.open(source_dir) as source, Dataset.create("one mode") as target:
        target.define_fields("training", source.fields("training").values())
        target.append("training", {name: view[:] for name, view in source["training"].items()})
    config = {"view": View(folds=4, fold=0), "normalize": True}
    training = train("one mode", through(factor=1.0), "split", data=config, epoch_nb=2)
    times = rows_of("sessions/split")["times"]
    assert times.sum() == 30 and training.validation_loss < 1e-12
    held = {"view": View(folds=4, hold_back=False, test_fold=0)}
    train("one mode", through(factor=1.0), "test", data=held, epoch_nb=2)
    assert rows_of("sessions/test")["times"].sum() == 30


def test_too_many_rejected_samples_end_the_training_and_are_kept(source_dir):
    config = through(refuse=2, max_wrong_samples_per_step=0, record_wrong_samples=True)
    with pytest.raises(WrongSamplesError, match="Instance 1, step 1"):
        train(source_dir, config)
    assert rows_of("sessions/training", "wrong")["step"].tolist() == [1]
    assert not rows_of("sessions/training")["times"].any()


@pytest.mark.slow
def test_a_source_whose_writer_was_killed_gives_its_committed_rows(source_dir):
    stored = rows_of(source_dir)
    left = Dataset.create("left open")
    with Dataset.open(source_dir) as dataset:
        left.define_fields("training", dataset.fields("training").values())
    left.append("training", {name: values[:15] for name, values in stored.items()})
    shutil.copytree("left open", "killed")  # the writer itself goes on
    before = content("killed")
    train("killed", through())
    assert content("killed") == before
    assert np.array_equal(rows_of("sessions/training")["x"], stored["x"][:15])
    left.close()


# The session's own samples ----------------------------------------------------------------------


def test_without_existing_dir_the_sessions_own_samples_are_replayed(source_dir):
    train(source_dir, through(), "own")
    train(None, through(factor=5.0), "own", new_session=False)
    rows = rows_of("sessions/own")
    assert (rows["times"] == 2).all() and np.allclose(rows["y"][:, 0], 5 * rows["x"].sum(axis=1))
    with pytest.raises(ConfigError, match="already has its own samples"):
        train(source_dir, through(), "own", new_session=False)
    with pytest.raises(DatasetError, match='no samples of mode "training" to send'):
        train(None, through(), "new")
    assert not Path("sessions/new").exists()


def test_what_environments_kept_with_the_source_comes_along(source_dir):
    DataGeneration(environment("Keeping"), session_name="kept", batch_nb=1, batch_size=5).execute()
    with Training(
        NetworkConfig("toy/linear", **NETWORK),
        DatasetConfig(existing_dir="sessions/kept"),
        through(name="Keeping"),
        epoch_nb=1,
        batch_size=5,
    ) as training:
        assert training.data.source._instances[0].environment.kept["steps"] == 5
        training.execute()


# What does not fit together ---------------------------------------------------------------------


def test_sources_that_exclude_each_other_are_named(source_dir):
    with pytest.raises(ConfigError, match="set load_samples=True"):
        train(source_dir, environment())
    with pytest.raises(ConfigError, match="always_produce generates new ones"):
        train(source_dir, through(always_produce=True))
    with pytest.raises(ConfigError, match="load_samples cannot be set"):
        DataGeneration(through(), batch_nb=1, batch_size=1).execute()
    with pytest.raises(FieldsMismatchError, match=r"cannot replay.*\n.*answer: is not one"):
        train(source_dir, through(name="Asking"))
    assert [path.name for path in Path("sessions").iterdir()] == ["run"]


def test_a_training_that_replays_is_resumed_only_where_it_can_be(source_dir):
    train(source_dir, through(only_first_epoch=False), "always", epoch_nb=2)
    with pytest.raises(ConfigError, match="cannot be resumed while environments generate"):
        train(source_dir, through(only_first_epoch=False), "always", epoch_nb=3, resume=True)
    train(source_dir, through(), "once", epoch_nb=2)
    train(source_dir, through(), "once", epoch_nb=3, resume=True)
    assert (rows_of("sessions/once")["times"] == 1).all()
    for config in (through(), None):  # it goes on with the copy, not with the source
        words = ["train", "--config", "sessions/once/config.toml", "--resume", "--epoch-nb", "4"]
        assert main(words) == 0
        training = train(source_dir, config, "once", epoch_nb=5, resume=True)
        assert training.data.dataset.directory == Path("sessions/once/dataset")


# Trainings with new samples ---------------------------------------------------------------------


@pytest.mark.parametrize("replays", [False, True])
def test_environments_may_ask_the_network_that_is_trained(replays, nothing_stays_behind):
    DataGeneration(
        environment("AskingOnlyInTraining"), session_name="run", batch_nb=1, batch_size=20
    ).execute()
    runs = []
    for over_tcp in (False, True):
        config = environment(
            "AskingOnlyInTraining", factor=3.0, load_samples=replays, as_tcp_ip_client=over_tcp
        )
        options = {"batch_nb": 4, "batch_size": 5, "data": {"shuffle": False, "view": ALL}}
        train("sessions/run" if replays else None, config, f"asked_{over_tcp}", **options)
        runs.append(rows_of(f"sessions/asked_{over_tcp}"))
    same(*runs)
    answers = runs[0]["answer"][:, 0]
    assert not answers[:5].any()  # the network knows nothing yet
    assert np.allclose(answers[5:], runs[0]["y"][5:, 0])


def test_a_training_begins_with_the_parameters_that_are_named(source_dir):
    for name, factor in (("one", 2.0), ("two", 4.0)):
        train(source_dir, through(factor=factor), name)
    for place, number, expected in (("sessions/one", -1, 2), ("sessions/two/network", 0, 4)):
        start = NetworkConfig("toy/linear", network_dir=place, which_network=number, **NETWORK)
        existing = DatasetConfig(existing_dir=source_dir)
        for name, new in (("new", True), ("one", False)):
            config = None if new else through()
            data = existing if new else None
            with Training(
                start, data, config, epoch_nb=1, batch_size=7, session_name=name, new_session=new
            ) as training:
                assert np.allclose(training.learner.network.weights[:, 0], [expected] * 2 + [0])


def test_always_produce_makes_all_epochs_anew_over_tcp_too(nothing_stays_behind):
    runs = []
    for over_tcp in (False, True):
        config = environment(num_clients=2, always_produce=True, as_tcp_ip_client=over_tcp)
        train(None, config, f"run_{over_tcp}", epoch_nb=3, batch_nb=2, batch_size=5)
        runs.append(rows_of(f"sessions/run_{over_tcp}"))
    same(*runs)
    assert len(np.unique(runs[0]["x"])) == 60
