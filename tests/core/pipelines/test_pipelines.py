import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    NetworkConfig,
    Observer,
    Prediction,
    Training,
    View,
)
from physx_core.cli import main
from physx_core.config import read_toml
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    DatasetError,
    DatasetNotFoundError,
    EnvironmentFailedError,
    FieldsMismatchError,
    NotFiniteError,
    PluginNotFoundError,
    SessionError,
    UsageError,
    WrongSamplesError,
)

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
LINEAR = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})


def generate(**changes):
    options = {"batch_nb": 4, "batch_size": 25, "session_name": "run", **changes}
    pipeline = DataGeneration(options.pop("environment_config", SPRING), **options)
    pipeline.execute()
    return pipeline


class Counting(Environment):
    """Gives its step as the only field; options make it misbehave."""

    def __init__(self, *, fail_in=None, bad_step=-1, refuse=False, **kwargs):
        super().__init__(**kwargs)
        self.fail_in, self.bad_step, self.refuse = fail_in, bad_step, refuse
        self.calls = []

    def call(self, name):
        self.calls.append(name)
        if self.fail_in == name:
            raise ValueError(f"on purpose in {name}")

    def create(self):
        self.call("create")

    def init(self):
        self.call("init")

    def init_database(self):
        self.call("init_database")
        self.define_training_fields([("x", np.ndarray)])
        self.define_additional_fields([("flag", bool)])

    async def step(self):
        self.call("step")
        value = np.nan if self.step_index == self.bad_step else float(self.step_index)
        self.set_training_data(x=np.array([value, self.instance_id]))
        self.set_additional_data(flag=self.compute_training_data)

    def check_sample(self):
        return not self.refuse and self.step_index % 3 != 1

    def close(self):
        self.call("close")


def counting(**kwargs):
    return EnvironmentConfig(Counting, env_kwargs=kwargs, as_tcp_ip_client=False, seed=0)


def test_generation_stores_what_was_asked_with_instance_and_step():
    pipeline = generate()
    with Dataset.open("sessions/run") as dataset:
        assert dataset.modes == ["training"] or list(dataset.modes) == ["training"]
        assert dataset.num_samples("training") == 100
        assert dataset["training"]["step"][:].tolist() == list(range(100))
        assert dataset.fields("training")["force"].unit == "N"
        assert dataset.info["seed"] == 1 and dataset.info["environment"] == "toy/spring"
        state, following = dataset["training"]["state"][:], dataset["training"]["next_state"][:]
        assert np.array_equal(state[1:], following[:-1])
    assert pipeline.batch_id == 4
    assert Path("sessions/run/config.toml").exists() and Path("sessions/run/info.txt").exists()


def test_several_instances_in_process_own_fixed_rows():
    generate(
        environment_config=EnvironmentConfig("toy/spring", num_clients=3, as_tcp_ip_client=False)
    )
    with Dataset.open("sessions/run") as dataset:
        assert dataset["training"]["env_id"][:7].tolist() == [1, 2, 3, 1, 2, 3, 1]


def test_modes_and_additions_do_not_repeat_samples():
    generate()
    generate(new_session=False)
    generate(new_session=False, mode="validation")
    with Dataset.open("sessions/run") as dataset:
        first = dataset["training"]["force"][:]
        assert len(first) == 200 and len(np.unique(first)) == 200
        assert not np.isin(dataset["validation"]["force"][:], first).any()


def test_same_seed_gives_the_same_rows_whatever_the_batches():
    generate(session_name="a")
    generate(session_name="b", batch_nb=10, batch_size=10)
    with Dataset.open("sessions/a") as a, Dataset.open("sessions/b") as b:
        assert np.array_equal(a["training"]["force"][:], b["training"]["force"][:])


def test_the_recorded_configuration_reproduces_the_run():
    config = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    generate(environment_config=config, session_name="a")
    recorded = read_toml("sessions/a/config.toml")["data_generation"]
    assert recorded["environment"]["seed"] is not None
    assert main(["generate", "--config", "sessions/a/config.toml"]) == 0
    with Dataset.open("sessions/a") as a, Dataset.open("sessions/a_1") as b:
        assert np.array_equal(a["training"]["force"][:], b["training"]["force"][:])


def test_rejected_samples_are_not_stored_and_substeps_do_not_compute():
    config = EnvironmentConfig(Counting, as_tcp_ip_client=False, simulations_per_step=3)
    generate(environment_config=config, batch_nb=1, batch_size=6)
    with Dataset.open("sessions/run") as dataset:
        assert dataset["training"]["step"][:].tolist() == [0, 2, 3, 5, 6, 8]
        assert dataset["training"]["flag"][:].all()
        assert dataset.fields("training")["flag"].role == "additional"


def test_events_are_called_in_order():
    calls = []

    class Mine(DataGeneration):
        def data_generation_begin(self):
            calls.append("begin")

        def batch_begin(self):
            calls.append("batch_begin")

        def batch_end(self):
            calls.append(len(self.batch["state"]))

        def data_generation_end(self):
            calls.append("end")

    Mine(SPRING, batch_nb=2, batch_size=3).execute()
    assert calls == ["begin", "batch_begin", 3, "batch_begin", 3, "end"]


@pytest.mark.parametrize("method", ["create", "init", "init_database", "step", "close"])
def test_failing_environments_are_named(method):
    with pytest.raises(
        EnvironmentFailedError, match=rf"Instance 1 raised in {method}\(\)"
    ) as caught:
        generate(environment_config=counting(fail_in=method))
    assert "on purpose" in caught.value.remote_traceback
    assert caught.value.method == method


def test_committed_rows_survive_invalid_sample():
    with pytest.raises(NotFiniteError, match='Instance 1, step 60: field "x"'):
        generate(environment_config=counting(bad_step=60))
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 25
        assert np.isfinite(dataset["training"]["x"][:]).all()


def test_refusing_all_samples_ends_with_an_error():
    with pytest.raises(WrongSamplesError, match="rejected 11 samples in a row"):
        generate(environment_config=counting(refuse=True))


def test_generation_has_no_network():
    class Asks(Counting):
        def step(self):
            self.set_training_data(x=np.zeros(2))
            self.get_prediction()

    with pytest.raises(UsageError, match="needs a network") as caught:
        generate(environment_config=EnvironmentConfig(Asks, as_tcp_ip_client=False))
    assert "step() of instance 1" in caught.value.__notes__[0]


def test_parameters_are_kept_with_the_dataset():
    class Keeps(Counting):
        def init(self):
            before = self.load_parameters()
            self.save_parameters(runs=before.get("runs", 0) + 1, table=np.arange(3, dtype="int8"))
            self.before = before

    config = EnvironmentConfig(Keeps, as_tcp_ip_client=False)
    generate(environment_config=config, batch_nb=1)
    with DataGeneration(
        config, session_name="run", new_session=False, batch_nb=1, batch_size=1
    ) as pipeline:
        before = pipeline.source._instances[0].environment.before
    assert before["runs"] == 1 and before["table"].dtype == "int8"


def test_training_on_a_dataset_learns_and_leaves_it_alone():
    generate()
    generate(new_session=False, mode="validation")
    before = {p.name: p.read_bytes() for p in Path("sessions/run/dataset").iterdir() if p.is_file()}
    training = Training(
        LINEAR, DatasetConfig(existing_dir="sessions/run"), epoch_nb=2, batch_size=20, seed=0
    )
    training.execute()
    after = {p.name: p.read_bytes() for p in Path("sessions/run/dataset").iterdir() if p.is_file()}
    assert before == after
    assert training.validation_loss < 1e-10
    assert (training.epoch_id, training.batch_id) == (2, 0)
    rows = Path("sessions/training/stats/scalars.csv").read_text().splitlines()
    assert rows[0] == "timeline,step,name,value"
    assert sum(row.startswith("batch,") and ",loss/batch," in row for row in rows) == 10
    assert sum("loss/validation" in row for row in rows) == 2


def test_training_with_environments_stores_the_first_epoch_and_reads_it_again():
    Training(LINEAR, None, SPRING, epoch_nb=3, batch_nb=4, batch_size=10).execute()
    with Dataset.open("sessions/training") as dataset:
        assert dataset.num_samples("training") == 40
    produce = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, always_produce=True)
    Training(
        LINEAR, None, produce, session_name="always", epoch_nb=3, batch_nb=4, batch_size=10
    ).execute()
    with Dataset.open("sessions/always") as dataset:
        assert dataset.num_samples("training") == 120


def test_each_epoch_is_kept_when_asked():
    generate()
    config = NetworkConfig("toy/linear", save_each_epoch=True)
    data = DatasetConfig(existing_dir="sessions/run", view=View(hold_back=False))
    Training(config, data, epoch_nb=3, batch_size=50).execute()
    names = sorted(p.name for p in Path("sessions/training/network").iterdir())
    assert names == ["network_0", "network_1", "network_2"]
    again = NetworkConfig("toy/linear", network_dir="sessions/training", which_network=1)
    Training(again, data, epoch_nb=1, batch_size=50).execute()
    with pytest.raises(CheckpointError, match="network_0, network_1, network_2"):
        Training(
            NetworkConfig("toy/linear", network_dir="sessions/training", which_network=3),
            data,
            epoch_nb=1,
            batch_size=50,
        ).execute()


def trained():
    generate(session_name="run")
    Training(
        LINEAR, None, session_name="run", new_session=False, epoch_nb=1, batch_size=100
    ).execute()


def test_prediction_gives_the_networks_answer_to_the_environment():
    trained()
    seen = []

    class Watch(Prediction):
        def sample_end(self):
            seen.append((self.batch["next_state"][0], self.prediction["next_state"][0]))

    Watch(NetworkConfig(), SPRING, session_name="run", step_nb=20, record=True).execute()
    assert len(seen) == 20
    with Dataset.open("sessions/run") as dataset:
        assert set(dataset.modes) == {"training", "prediction"}
        stored = dataset["prediction"]
        assert np.allclose(stored["next_state"][:], stored["predicted_next_state"][:], atol=1e-9)
        assert not np.isin(stored["force"][:], dataset["training"]["force"][:]).any()


def test_an_environment_may_ask_within_its_step():
    trained()

    class Asks(Counting):
        def init_database(self):
            self.define_training_fields([("state", np.ndarray), ("force", np.ndarray)])

        def step(self):
            self.set_training_data(state=np.ones(2), force=np.zeros(1))
            self.set_training_data(state=self.get_prediction()["next_state"], force=np.zeros(1))

    Prediction(
        NetworkConfig(),
        EnvironmentConfig(Asks),
        session_name="run",
        step_nb=1,
        record=True,
    ).execute()
    with Dataset.open("sessions/run") as dataset:
        assert abs(dataset["prediction"]["state"][0] - [1.012, 0.59]).max() < 0.05


def test_prediction_uses_the_session_configured():
    with pytest.raises(SessionError, match='no session "training"'):
        Prediction(NetworkConfig(), SPRING, step_nb=1).execute()
    generate(session_name="training")
    with pytest.raises(CheckpointError, match="no network in"):
        Prediction(NetworkConfig(), SPRING, step_nb=1).execute()


def test_bad_input_of_training_is_named_and_leaves_no_session():
    data = DatasetConfig(existing_dir="nowhere")
    with pytest.raises(DatasetNotFoundError, match="nowhere"):
        Training(LINEAR, data, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(PluginNotFoundError):
        Training(NetworkConfig("tooy/linear"), data, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(ConfigError, match="not both"):
        Training(LINEAR, data, SPRING, epoch_nb=1, batch_size=1).execute()
    assert not Path("sessions").exists()
    generate()
    data = DatasetConfig(existing_dir="sessions/run")
    wrong = NetworkConfig("toy/linear", network_kwargs={"net_fields": "speed"})
    with pytest.raises(FieldsMismatchError, match="speed: missing"):
        Training(wrong, data, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(ConfigError, match='has no option "layers"'):
        unknown = NetworkConfig("toy/linear", network_kwargs={"layers": 3})
        Training(unknown, data, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(DatasetError, match='no samples of mode "validation"'):
        other = DatasetConfig(existing_dir="sessions/run", mode="validation")
        Training(LINEAR, other, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(ConfigError, match="batch_nb"):
        Training(LINEAR, None, SPRING, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(PluginNotFoundError):
        generate(environment_config=EnvironmentConfig("toy/spring", visualizer="nothing"))
    assert [p.name for p in Path("sessions").iterdir()] == ["run"]


def test_existing_sessions_of_other_fields_are_refused():
    generate()
    with pytest.raises(FieldsMismatchError):
        generate(environment_config=counting(), new_session=False)
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 100


def test_a_failing_observer_is_muted_and_the_run_goes_on(monkeypatch):
    class Fails(Observer):
        def advance(self, count):
            raise RuntimeError("viewer broke")

    class Mine(DataGeneration):
        def _open(self, resources):
            super()._open(resources)
            self.observers._observers.append(Fails())

    with pytest.warns(UserWarning, match="Fails failed and is disabled.*viewer broke"):
        Mine(SPRING, batch_nb=3, batch_size=2).execute()


def test_ctrl_c_keeps_committed_rows_and_writes_checkpoint(tmp_path):
    script = tmp_path / "endless.py"
    script.write_text(
        "from physx_core import *\n"
        "if __name__ == '__main__':\n"
        "    spring = EnvironmentConfig(\n"
        "        'toy/spring', as_tcp_ip_client=False, always_produce=True)\n"
        "    Training(NetworkConfig('toy/linear'), None, spring,\n"
        "             epoch_nb=10**6, batch_nb=10, batch_size=10).execute()\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True)
    stats = tmp_path / "sessions/training/stats/scalars.csv"
    deadline = time.monotonic() + 60
    while not (stats.exists() and "\nepoch," in stats.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, text = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in text
    assert list(tmp_path.glob("sessions/training/network/network_0/checkpoint.toml"))
    with Dataset.open("sessions/training") as dataset:
        assert dataset.num_samples("training") >= 100 and dataset.verify() == []
