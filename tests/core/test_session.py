import subprocess
import sys
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
from physx_core.cli import main
from physx_core.errors import EnvironmentFailedError, SessionError
from physx_core.session import Session

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", {"mass": 2.0}, as_tcp_ip_client=False)


def test_new_sessions_get_the_next_number_whatever_lies_beside(tmp_path):
    (tmp_path / "run_old").mkdir()
    (tmp_path / "run_7").mkdir()
    names = [Session.create(tmp_path, "run").name for _ in range(3)]
    assert names == ["run", "run_8", "run_9"]


def test_an_existing_session_is_used_when_asked(tmp_path):
    Session.create(tmp_path, "run")
    assert Session.create(tmp_path, "run", new_session=False).name == "run"


def test_missing_sessions_are_named_with_those_that_exist(tmp_path):
    Session.create(tmp_path, "training")
    with pytest.raises(SessionError, match='no session "trainin".*Did you mean "training"'):
        Session.existing(tmp_path, "trainin")


@pytest.mark.parametrize("name", ["", "a/b", ".."])
def test_invalid_names_are_rejected(tmp_path, name):
    with pytest.raises(SessionError):
        Session.create(tmp_path, name)


def test_a_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / "sessions").write_text("")
    with pytest.raises(SessionError, match="Cannot create"):
        Session.create(tmp_path / "sessions", "run")


def test_a_session_that_cannot_be_written_to_is_named(tmp_path):
    session = Session.create(tmp_path, "run")
    (session.path / "config.toml.tmp").mkdir()
    with pytest.raises(SessionError, match="session .*run cannot be written to"):
        session.record("training", {"epoch_nb": 1}, 5)


def test_record_adds_to_info_and_keeps_the_notes(tmp_path):
    session = Session.create(tmp_path, "run")
    session.record("training", {"epoch_nb": 1}, 5)
    info = session.path / "info.txt"
    info.write_text(info.read_text().replace("(Write here", "MINE (Write here"))
    session.record("prediction", {"step_nb": 2}, 6)
    text = info.read_text()
    assert "MINE" in text and "seed: 5" in text and "step_nb = 2" in text and "numpy" in text
    assert "[training]" in (session.path / "config.toml").read_text()
    assert "[prediction]" in (session.path / "config.toml").read_text()


def test_folders_of_similar_names_do_not_disturb_the_numbers(tmp_path):
    for name in ("training_old", "training_1_old", "training_x2", "training_-3", "xtraining_9"):
        (tmp_path / name).mkdir()
    (tmp_path / "training_4").write_text("a file")
    names = [Session.create(tmp_path, "training").name for _ in range(3)]
    assert names == ["training", "training_5", "training_6"]
    assert Session.create(tmp_path, "training_old").name == "training_old_1"


def test_names_are_unique_when_several_make_sessions_at_once(tmp_path):
    code = (
        "import sys; from physx_core.session import Session\n"
        "for _ in range(20): print(Session.create(sys.argv[1], 'run').name)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    names = [name for p in processes for name in p.communicate(timeout=60)[0].split()]
    assert len(names) == len(set(names)) == 40


# What a run leaves in its session ---------------------------------------------------------------


def train(name="training", **options):
    config = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
    data = DatasetConfig(existing_dir="sessions/data_generation", normalize=True)
    pipeline = Training(config, data, session_name=name, epoch_nb=2, batch_size=9, **options)
    pipeline.execute()
    return pipeline


def test_info_tells_of_all_components():
    DataGeneration(SPRING, batch_nb=2, batch_size=20).execute()
    pipeline = train()
    text = Path("sessions/training/info.txt").read_text()
    assert "network: Linear" in text and "state, force -> next_state, 8 parameters" in text
    assert "optimization: LeastSquares" in text and "transformation: Transformation" in text
    assert "environment: none" in text and "training: 40 samples" in text
    assert "force (1,) <f8 in N" in text
    assert "physx-core" in text and f"seed: {pipeline._resumed.seed}" in text
    assert "finished after" in text
    Prediction(NetworkConfig(), SPRING, session_name="training", step_nb=1).execute()
    assert "environment: toy/spring\n  mass = 2.0" in Path("sessions/training/info.txt").read_text()


def test_info_tells_how_a_run_ended():
    Session.create("sessions", "data_generation")
    config = EnvironmentConfig("toy/spring", {"period": "x"}, as_tcp_ip_client=False)
    with pytest.raises(EnvironmentFailedError):
        DataGeneration(config, batch_nb=1, batch_size=1, new_session=False).execute()
    text = Path("sessions/data_generation/info.txt").read_text()
    assert "ended by EnvironmentFailedError after" in text


def test_notes_stay_where_they_are():
    DataGeneration(SPRING, batch_nb=2, batch_size=20).execute()
    info = Path("sessions/data_generation/info.txt")
    info.write_text(info.read_text().replace("(Write here", "With a heavier mass.\n(Write here"))
    DataGeneration(SPRING, batch_nb=1, batch_size=2, new_session=False).execute()
    text = info.read_text()
    assert text.startswith("Session data_generation\n\nNotes\n-----\nWith a heavier mass.\n")
    assert text.count("finished after") == 2


def test_a_training_runs_again_from_its_file():
    DataGeneration(SPRING, batch_nb=2, batch_size=20).execute()
    train()
    assert main(["train", "--config", "sessions/training/config.toml"]) == 0
    first, second = (
        Path(f"sessions/{name}/network/network_0/parameters.npz").read_bytes()
        for name in ("training", "training_1")
    )
    assert first == second
    numbers = [
        Path(f"sessions/{n}/stats/scalars.csv").read_text() for n in ("training", "training_1")
    ]
    assert numbers[0] == numbers[1]


CODE = """
import numpy as np
from physx_core import *

class Mean(Environment):
    def create(self): pass
    def init_database(self):
        self.define_training_fields([("x", np.ndarray), ("y", np.ndarray)])
    def step(self):
        x = self.rng.random(4)
        self.set_training_data(x=x, y=x[:1] + x[1:2])

mean = EnvironmentConfig(Mean, as_tcp_ip_client=False)
DataGeneration(mean, batch_nb=3, batch_size=10, session_dir="here").execute()
network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
Training(network, DatasetConfig(existing_dir="here/data_generation"), session_dir="here",
         epoch_nb=1, batch_size=10).execute()
Prediction(NetworkConfig(), mean, session_dir="here", step_nb=3, record=True).execute()
"""


@pytest.mark.parametrize("how", ["python -c", "interactive"])
def test_everything_runs_without_a_script_file(tmp_path, how):
    """What a notebook does: the code of a cell has no file."""
    words, text = (
        (["-c", CODE], None) if how == "python -c" else (["-i", "-q"], f"exec({CODE!r})\n")
    )
    done = subprocess.run(
        [sys.executable, *words],
        input=text,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and "Error" not in done.stderr, done.stderr
    assert sorted(p.name for p in (tmp_path / "here").iterdir()) == ["data_generation", "training"]
    with Dataset.open(tmp_path / "here" / "training") as dataset:
        predicted, y = (dataset["prediction"][name][:] for name in ("predicted_y", "y"))
    assert len(y) == 3 and np.allclose(predicted, y)
