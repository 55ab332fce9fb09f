"""What check_sample rejects: recorded in the mode "wrong", in the same order however it is made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.cli import main
from physx_core.errors import UsageError, WrongSamplesError

pytestmark = pytest.mark.processes

PICKY = f"{(Path(__file__).parents[1] / 'programs' / 'source_envs.py')}:Picky"


def picky(**options):
    kwargs = {name: options.pop(name) for name in ("spoil", "stuck", "late") if name in options}
    options = {"record_wrong_samples": True, "seed": 3, **options}
    return EnvironmentConfig(PICKY, env_kwargs=kwargs, **options)


def run(config, name, **options):
    options = {"batch_nb": 4, "batch_size": 7, "session_name": name, **options}
    DataGeneration(config, **options).execute()


def rows_of(name, mode):
    with Dataset.open(f"sessions/{name}") as dataset:
        if mode not in dataset:
            return {}
        return {field: view[:] for field, view in dataset[mode].items()}


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


# Sources ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("instances", "ahead"), [(1, None), (3, None), (3, 0)])
def test_rejected_rows_are_those_of_a_local_source(local, simulated, instances, ahead):
    settings = {"num_clients": instances, "record_wrong_samples": True}
    found = 0
    with local(PICKY, **settings) as ours, simulated(PICKY, run_ahead=ahead, **settings) as theirs:
        for size in (1, 2, 50, 1, 7, 300):
            same(theirs.batch(size), ours.batch(size))
            wrong = ours.pop_rejected()
            same(theirs.pop_rejected(), wrong)
            assert ours.pop_rejected() == theirs.pop_rejected() == {}
            found += len(wrong.get("step", ()))
    assert found > 50


def test_rejected_rows_come_by_instance_then_step_before_their_accepted_ones(local):
    with local(PICKY, num_clients=3, record_wrong_samples=True) as source:
        before = dict.fromkeys((1, 2, 3), -1)
        for _ in range(5):
            rows = source.batch(9)
            wrong = source.pop_rejected()
            places = list(zip(wrong["env_id"], wrong["step"], strict=True))
            assert places == sorted(places)
            for number in (1, 2, 3):
                steps = rows["step"][rows["env_id"] == number]
                rejected = wrong["step"][wrong["env_id"] == number]
                made = sorted([*steps, *rejected])
                assert made == list(range(before[number] + 1, steps[-1] + 1))
                before[number] = steps[-1]
            assert (wrong["state"][:, 0] > 0.6).all()
            assert (rows["state"][:, 0] <= 0.6).all()


def test_those_of_a_batch_are_forgotten_with_the_next(local, simulated):
    settings = {"num_clients": 2, "record_wrong_samples": True}
    with local(PICKY, **settings) as ours, simulated(PICKY, **settings) as theirs:
        for source in (ours, theirs):
            source.batch(100)
            source.batch(4)
        same(theirs.pop_rejected(), ours.pop_rejected())


def test_nothing_is_kept_unless_it_is_asked_for(local, simulated):
    with local(PICKY) as ours, simulated(PICKY) as theirs:
        for source in (ours, theirs):
            source.batch(50)
            assert source.pop_rejected() == {}


@pytest.mark.parametrize("spoil", ["nan", "shape", "name", "ragged", "text"])
def test_rejected_samples_that_are_invalid_are_left_out(local, simulated, spoil):
    settings = {
        "num_clients": 2,
        "record_wrong_samples": True,
        "env_kwargs": {"spoil": spoil},
    }
    with local(PICKY, **settings) as ours, simulated(PICKY, **settings) as theirs:
        same(ours.batch(60), theirs.batch(60))
        wrong = ours.pop_rejected()
        same(theirs.pop_rejected(), wrong)
    steps = wrong["step"][wrong["env_id"] == 1]
    assert len(steps) and (steps % 2 == 0).all()
    assert np.isfinite(wrong["state"]).all()


# Generation -------------------------------------------------------------------------------------


@pytest.mark.parametrize("instances", [1, 3])
def test_they_are_stored_the_same_in_process_and_over_tcp(instances, nothing_stays_behind):
    for over_tcp in (False, True):
        config = picky(num_clients=instances, as_tcp_ip_client=over_tcp)
        run(config, f"run_{over_tcp}")
    for mode in ("training", "wrong"):
        same(rows_of("run_True", mode), rows_of("run_False", mode))
    training, wrong = rows_of("run_True", "training"), rows_of("run_True", "wrong")
    assert list(training) == list(wrong) and len(training["step"]) == 28 < len(wrong["step"]) * 10
    with Dataset.open("sessions/run_True") as dataset:
        assert dataset.modes == ["training", "wrong"]
        assert dataset.fields("wrong") == dataset.fields("training")
        assert dataset.fields("wrong")["state"].unit == "m"
        assert dataset.fields("wrong")["drawn"].role == "additional"
        assert dataset.verify() == []


def test_the_accepted_rows_are_the_same_with_and_without():
    run(picky(as_tcp_ip_client=False), "with")
    run(picky(as_tcp_ip_client=False, record_wrong_samples=False), "without")
    same(rows_of("with", "training"), rows_of("without", "training"))
    assert rows_of("without", "wrong") == {}


@pytest.mark.parametrize("stuck", [8, 0])
@pytest.mark.parametrize("instances", [1, 3])
def test_too_many_name_the_instance_and_are_recorded(instances, stuck, nothing_stays_behind):
    for over_tcp in (False, True):
        config = picky(
            num_clients=instances,
            as_tcp_ip_client=over_tcp,
            stuck=(instances, stuck),
            max_wrong_samples_per_step=6,
            late=0.02,
        )
        with pytest.raises(WrongSamplesError, match="rejected 7 samples in a row") as caught:
            run(config, f"run_{over_tcp}")
        assert caught.value.instance_id == instances
    for mode in ("training", "wrong"):
        same(rows_of("run_True", mode), rows_of("run_False", mode))
    wrong = rows_of("run_True", "wrong")
    assert wrong["step"][wrong["env_id"] == instances][-7:].tolist() == list(
        range(caught.value.step - 6, caught.value.step + 1)
    )


def test_the_mode_is_one_like_others_for_the_commands(capsys):
    run(picky(as_tcp_ip_client=False), "run")
    wrong = rows_of("run", "wrong")
    assert main(["info", "sessions/run"]) == 0
    assert f"wrong: {len(wrong['step'])} samples" in capsys.readouterr().out
    assert main(["verify", "sessions/run"]) == 0
    assert f"{len(wrong['step'])} wrong samples" in capsys.readouterr().out
    assert main(["export", "sessions/run", "out.npz", "--to", "npz"]) == 0
    assert main(["import", "out.npz", "back"]) == 0
    with Dataset.open("back") as dataset:
        same({name: view[:] for name, view in dataset["wrong"].items()}, wrong)


def test_a_run_that_is_added_goes_on_recording():
    run(picky(as_tcp_ip_client=False), "run")
    first = rows_of("run", "wrong")
    run(picky(as_tcp_ip_client=False), "run", new_session=False)
    both = rows_of("run", "wrong")
    count = len(first["step"])
    same({name: values[:count] for name, values in both.items()}, first)
    assert len(both["step"]) > count
    assert not np.isin(both["state"][count:], first["state"]).any()


def test_stored_rows_must_be_as_many_as_the_batch(local, simulated):
    for make in (local, simulated):
        with make("Plain") as source, pytest.raises(UsageError, match="3 stored rows"):
            source.batch(4, {"x": np.zeros((3, 2))})
    with simulated("Plain") as source, pytest.raises(UsageError, match="run_ahead=0"):
        source.batch(3, {"x": np.zeros((3, 2))})
