"""What an instance keeps with save_parameters: beside the dataset, for later runs, over TCP too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
)
from physx_core.components import Observer
from physx_core.errors import DatasetError
from physx_core.pipelines.services import RunServices

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "source_envs.py"


def keeping(over_tcp=False, **options):
    options = {"num_clients": 2, "seed": 0, **options}
    return EnvironmentConfig(f"{ENVS}:Keeping", as_tcp_ip_client=over_tcp, **options)


def generate(config, **options):
    DataGeneration(
        config, **{"session_name": "run", "batch_nb": 1, "batch_size": 6, **options}
    ).execute()


def kept(session, number):
    services = RunServices(Path("sessions") / session / "dataset", Observer(), None)
    return services.load_parameters(number)


@pytest.mark.parametrize("over_tcp", [False, True])
def test_each_instance_finds_its_own_in_a_later_run(over_tcp, nothing_stays_behind):
    for run in (1, 2, 3):
        generate(keeping(over_tcp), new_session=False)
        for number in (1, 2):
            found = kept("run", number)
            assert found["runs"] == run and found["steps"] == 3 * run
            assert found["who"] == (number, "name") and found["late"] is True
            assert found["table"].tolist() == [run, run]
    assert kept("run", 3) == {}
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 18 and dataset.verify() == []
    generate(keeping(over_tcp))
    assert kept("run_1", 1)["runs"] == 1


def test_what_was_kept_over_tcp_is_found_in_process(nothing_stays_behind):
    for run, over_tcp in enumerate((True, False, True), start=1):
        generate(keeping(over_tcp), new_session=False)
        assert kept("run", 2)["steps"] == 3 * run


def test_files_are_the_same_in_process_and_over_tcp(nothing_stays_behind):
    for over_tcp in (False, True):
        generate(keeping(over_tcp), session_name=f"run_{over_tcp}")
    for number in (1, 2):
        one, other = (
            Path(f"sessions/run_{over_tcp}/dataset/parameters_{number}.bin")
            for over_tcp in (False, True)
        )
        assert one.read_bytes() == other.read_bytes()


def test_a_training_and_a_prediction_find_those_of_their_session(nothing_stays_behind):
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    generate(keeping(), session_name="training")
    options = {"epoch_nb": 1, "batch_size": 6, "batch_nb": 1, "new_session": False}
    Training(network, None, keeping(over_tcp=True), **options).execute()
    assert kept("training", 2)["runs"] == 2
    for over_tcp in (False, True):
        Prediction(network, keeping(over_tcp), step_nb=4).execute()
    assert kept("training", 2)["runs"] == 4 and kept("training", 2)["steps"] == 14


def test_a_replay_finds_those_of_the_samples_and_leaves_them_alone():
    generate(keeping(), session_name="source")
    before = [kept("source", number) for number in (1, 2)]
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    data = DatasetConfig(existing_dir="sessions/source")
    Training(network, data, epoch_nb=1, batch_size=6).execute()
    Prediction(network, keeping(load_samples=True), data, step_nb=4).execute()
    assert kept("training", 1)["runs"] == 2 and kept("training", 1)["steps"] == 7
    after = [kept("source", number) for number in (1, 2)]
    assert str(before) == str(after)


def test_a_damaged_file_is_named():
    generate(keeping())
    path = Path("sessions/run/dataset/parameters_1.bin")
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DatasetError, match=r"parameters_1\.bin is damaged"):
        generate(keeping(), new_session=False)
    assert np.isfinite(kept("run", 2)["table"]).all()
