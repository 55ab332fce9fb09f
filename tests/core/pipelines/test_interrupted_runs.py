"""Runs that end before their time: by SIGTERM, by an error, by a network that diverges."""

from __future__ import annotations

import dataclasses
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
    EnvironmentConfig,
    NetworkConfig,
    Training,
    View,
    checkpoint,
    files,
    read_scalars,
)
from physx_core.cli import main
from physx_core.errors import ConfigError, DivergedError, EnvironmentFailedError, UsageError
from physx_core.toy import LeastSquares, Linear, Spring

ALL = View(hold_back=False)

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
NETWORK = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
DATA = DatasetConfig(existing_dir="sessions/run", view=ALL)
OPTIONS = {"epoch_nb": 3, "batch_size": 10, "seed": 2}


@pytest.fixture(autouse=True)
def run():
    """A session with forty samples."""
    DataGeneration(SPRING, session_name="run", batch_nb=4, batch_size=10).execute()


def progress(session="training", number=0):
    found = checkpoint.read(Path(f"sessions/{session}/network/network_{number}"))
    return found.progress.epoch, found.progress.batch


def checkpoints(session="training"):
    return sorted(path.name for path in Path(f"sessions/{session}/network").glob("*"))


# Within epochs ------------------------------------------------------------------------------------


def test_last_two_checkpoints_within_epochs_are_kept(monkeypatch):
    done = []
    for name in ("rename", "sync_folder"):
        operation = getattr(files, name)
        monkeypatch.setattr(
            files, name, lambda *paths, do=operation: (done.append(paths), do(*paths))[1]
        )
    network = dataclasses.replace(NETWORK, save_each_epoch=True)
    Training(network, DATA, checkpoint_every=1, **OPTIONS).execute()
    assert checkpoints() == [f"network_{n}" for n in (12, 13, 14, 4, 9)]
    assert [progress(number=n) for n in (4, 9, 12, 13, 14)] == [
        (1, 0), (2, 0), (2, 3), (2, 4), (3, 0)
    ]  # fmt: skip
    folder = Path("sessions/training/network")
    hidden = folder / ".network_0.partial"
    appears = done.index((folder / ".network_2.partial", folder / "network_2"))
    vanishes = done.index((folder / "network_0", hidden))
    assert (folder,) in done[appears:vanishes]  # the new one is on the disk by then


def test_training_killed_while_removing_checkpoint_resumes(monkeypatch):
    network = NetworkConfig(Linear, optimization=Descending)
    Training(network, DATA, session_name="whole", checkpoint_every=1, **OPTIONS).execute()
    rename = files.rename

    def killed(path, target):
        rename(path, target)
        if path.name == "network_1":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(files, "rename", killed)
        Training(network, DATA, checkpoint_every=1, **OPTIONS).execute()
    assert checkpoints() == [".network_1.partial", "network_2", "network_3"]
    Training(network, DATA, checkpoint_every=1, resume=True, **OPTIONS).execute()
    assert checkpoints() == checkpoints("whole")
    last = [Path(f"sessions/{name}/network/network_12") for name in ("training", "whole")]
    one, two = (np.load(path / "parameters.npz")["weights"] for path in last)
    assert one.tobytes() == two.tobytes()


def test_resume_from_checkpoint_of_each_epoch():
    network = NetworkConfig(Linear, optimization=Descending)
    options = {**OPTIONS, "checkpoint_every": "epoch"}
    Training(network, DATA, session_name="whole", **options).execute()
    assert checkpoints("whole") == [f"network_{n}" for n in (1, 2, 3)]
    assert [progress("whole", n) for n in (1, 2, 3)] == [(1, 4), (2, 4), (3, 0)]

    class Killed(Training):
        def batch_begin(self):
            if self.epoch_id == 2 and self.batch_id == 1:
                raise SystemExit

        def save_checkpoint(self):
            return super().save_checkpoint() if self.batch_id != 1 else None

    with pytest.raises(UsageError, match="not finished"):
        Killed(network, DATA, **options).execute()
    Training(network, DATA, resume=True, **options).execute()
    last = [Path(f"sessions/{name}/network") for name in ("training", "whole")]
    newest = [max(place.glob("network_[0-9]"), key=lambda p: p.name) for place in last]
    one, two = (np.load(path / "parameters.npz")["weights"] for path in newest)
    assert one.tobytes() == two.tobytes()
    assert read_scalars(Path("sessions/training")) == read_scalars(Path("sessions/whole"))


def test_checkpoint_every_is_a_number_or_epoch():
    for wrong in (-1, "batch"):
        with pytest.raises(ConfigError, match="checkpoint_every"):
            Training(NETWORK, DATA, **OPTIONS, checkpoint_every=wrong)


# SIGTERM ------------------------------------------------------------------------------------------

HEAD = """
from physx_core import *
from physx_core.pipelines import Replay
if __name__ == "__main__":
    data = DatasetConfig(existing_dir="sessions/run", view=View(hold_back=False))
    spring = EnvironmentConfig("toy/spring", num_clients=2, seed=1)
    alone = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, always_produce=True)
    busy = EnvironmentConfig("toy/spring", num_clients=2, always_produce=True)
    network = NetworkConfig("toy/linear")
"""
PIPELINES = {
    "generation": 'DataGeneration(spring, session_name="new", batch_nb=10**7, batch_size=6)',
    "training": 'Training(network, data, session_name="new", epoch_nb=10**7, batch_size=10)',
    "online training": 'Training(network, None, alone, session_name="new", epoch_nb=10**7,'
    " batch_nb=10, batch_size=10)",
    "training with clients": 'Training(network, None, busy, session_name="new", epoch_nb=10**7,'
    " batch_nb=10, batch_size=10)",
    "prediction": 'Prediction(NetworkConfig(), spring, session_name="trained", record=True)',
    "replay": 'Replay(data, spring, session_name="new", step_nb=-1)',
}


def signaled(text, sent, *, pause=0.6, words=("script.py",)):
    """Run a program, send it signals once it is at work, and return its status and its errors."""
    Path("script.py").write_text(text)
    process = subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
        if Path("working").exists():
            break
    for number in sent:
        process.send_signal(number)
        time.sleep(pause)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors


def saying(make, event):
    """The program of a pipeline that makes a file when it is at work."""
    kind = make.partition("(")[0]
    return HEAD + (
        f"    class Telling({kind}):\n"
        f"        def {event}(self):\n"
        f"            super().{event}()\n"
        "            open('working', 'w').close()\n"
        f"    {make.replace(kind, 'Telling', 1)}.execute()\n"
    )


EVENTS = {"generation": "batch_end", "prediction": "sample_end", "replay": "sample_end"}
CHECKPOINT = "checkpoint: sessions/new/network/network_0"
AGAIN = "next: physx train --config sessions/new --network.network-dir sessions/new"
LEFT = {
    "generation": ["next: physx info sessions/new"],
    "training": [CHECKPOINT, "next: physx train sessions/new --resume"],
    "online training": [CHECKPOINT, "next: physx train sessions/new --resume"],
    "training with clients": [CHECKPOINT, "next: physx train sessions/new --resume"],
    "prediction": ["next: physx info sessions/trained"],
    "replay": ["session: sessions/new was removed: the run stored nothing in it"],
}


@pytest.mark.parametrize("kind", PIPELINES)
def test_sigterm_ends_pipeline_cleanly_with_status_143(kind, nothing_stays_behind):
    Training(NETWORK, DATA, session_name="trained", **OPTIONS).execute()
    code, text = signaled(saying(PIPELINES[kind], EVENTS.get(kind, "batch_end")), [signal.SIGTERM])
    assert code == 143 and "Traceback" not in text
    assert set(LEFT[kind]) <= set(text.splitlines())
    session = "trained" if kind == "prediction" else "new"
    if kind != "replay":
        assert "interrupted after" in Path(f"sessions/{session}/info.txt").read_text()
    if "training" in kind:
        assert checkpoints("new") == ["network_0"] and progress("new") != (0, 0)
    if kind in ("generation", "online training", "training with clients", "prediction"):
        with Dataset.open(f"sessions/{session}") as dataset:
            mode = "prediction" if kind == "prediction" else "training"
            assert dataset.num_samples(mode) > 0 and dataset.verify() == []
            described = dataset.describe()
        assert "open" not in str(described)


def test_a_second_signal_ends_a_training_at_once():
    text = saying(PIPELINES["training"], "batch_end").replace(
        "open('working', 'w').close()", "open('working', 'w').close(); import time; time.sleep(30)"
    )
    began = time.monotonic()
    code, _ = signaled(text, [signal.SIGTERM, signal.SIGTERM])
    assert code == 143 and time.monotonic() - began < 25
    assert not Path("sessions/new/network").exists()


def test_a_signal_that_is_sent_to_the_process_and_to_its_group_is_one():
    text = saying(PIPELINES["training"], "batch_end")
    text = text.replace("close()", "close(); import time; time.sleep(0.2)")
    code, text = signaled(text, [signal.SIGTERM, signal.SIGTERM], pause=0.05)
    assert code == 143 and set(LEFT["training"]) <= set(text.splitlines())


@pytest.mark.parametrize("busy", ["optimize", "batch_produce"])
def test_second_signal_ends_online_training(busy, nothing_stays_behind):
    """It is learning, or waits for a client that takes its time."""
    slow = Path(__file__).parents[1] / "programs" / "online_envs.py"
    make = (
        f'Training(NetworkConfig("toy/linear", network_kwargs={{"net_fields": "x", "opt_fields":'
        f' "y"}}), None, EnvironmentConfig("{slow}:Pupil", env_kwargs={{"asks": True, "delay": '
        f"{1e4 * (busy == 'batch_produce')}}}), epoch_nb=1, batch_nb=1000, batch_size=5)"
    )
    text = saying(make, "train_begin")
    if busy == "optimize":
        text = saying(make, "optimize").replace("close()", "close(); import time; time.sleep(60)")
    began = time.monotonic()
    code, _ = signaled(text, [signal.SIGTERM, signal.SIGTERM])
    assert code == 143 and time.monotonic() - began < 50


def test_the_command_ends_with_143_too():
    words = ["-m", "physx_core", "train", "sessions/run", "--network.network", "toy/linear"]
    words += ["--epoch-nb", "10000000", "--batch-size", "10", "--session-name", "new"]
    process = subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE, text=True)
    stats, deadline = Path("sessions/new/stats/scalars.csv"), time.monotonic() + 60
    while not (stats.exists() and stats.stat().st_size > 500) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143 and "terminated" in errors
    assert checkpoints("new") == ["network_0", "network_best"]


def test_sigterm_is_left_alone_where_it_is_handled():
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        Training(NETWORK, DATA, **OPTIONS).execute()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)
    Training(NETWORK, DATA, **OPTIONS).execute()
    assert signal.getsignal(signal.SIGTERM) == before


# Errors -------------------------------------------------------------------------------------------


class Failing(Spring):
    """Fails in a step after the first epoch."""

    def step(self):
        if self.step_index == 47:
            raise ZeroDivisionError("the solver diverged")
        super().step()


def test_environment_failure_leaves_checkpoint():
    config = EnvironmentConfig(Failing, as_tcp_ip_client=False, seed=1, always_produce=True)
    with pytest.raises(EnvironmentFailedError, match="the solver diverged") as caught:
        Training(NETWORK, None, config, batch_nb=3, **OPTIONS).execute()
    place = Path("sessions/training/network/network_0")
    assert str(place) in caught.value.__notes__[-1]
    assert "resume=True (physx train --resume) continues" in caught.value.__notes__[-1]
    assert progress() == (1, 1)
    Training(NETWORK, batch_nb=3, resume=True, **OPTIONS).execute()
    assert progress(number=1) == (3, 0)


class Asking(Failing):
    """Moves as the network that learns predicts."""

    def step(self):
        super().step()
        self.state = (
            self.state + self.get_prediction(state=self.state, force=np.zeros(1))["next_state"]
        )


def test_training_without_resume_names_alternative(capfd):
    config = EnvironmentConfig(Asking, as_tcp_ip_client=False, seed=1)
    with pytest.raises(EnvironmentFailedError) as caught:
        Training(NETWORK, None, config, batch_nb=9, **OPTIONS).execute()
    assert "NetworkConfig.network_dir" in caught.value.__notes__[-1]
    last = capfd.readouterr().err.splitlines()[-1]
    assert last == AGAIN.replace("new", "training")
    with pytest.raises(ConfigError, match=r"depend on the learning network.*network_dir"):
        Training(NETWORK, None, config, batch_nb=9, resume=True, **OPTIONS).execute()
    words = last.removeprefix("next: physx ").split()
    assert main([*words, "--environment.environment", "toy/spring", "--batch-nb", "1"]) == 0
    assert progress("training_1") == (3, 0)
    with (
        pytest.raises(ConfigError, match="--network.network-dir sessions/training"),
        pytest.warns(UserWarning, match='"training_1" is newer'),
    ):
        Training(NETWORK, None, config, batch_nb=9, resume=True, **OPTIONS).execute()


def test_an_environment_that_fails_before_the_first_batch_leaves_no_checkpoint():
    config = EnvironmentConfig(Failing, as_tcp_ip_client=False, seed=1)
    with pytest.raises(EnvironmentFailedError):
        Training(NETWORK, None, config, epoch_nb=1, batch_nb=1, batch_size=100).execute()
    assert checkpoints() == []


class Descending(LeastSquares):
    """Goes down the gradient, without a memory of earlier batches."""

    def optimize(self, loss):
        error = self._rows @ self._network.weights - self._targets
        self._network.weights -= 1e-3 * self._rows.T @ error


def test_resume_after_error_within_epoch_is_bit_identical():
    class Mine(Training):
        def batch_end(self):
            if (self.epoch_id, self.batch_id) == (1, 2):
                raise OSError("the notes are full")

    network = NetworkConfig(Linear, optimization=Descending)
    with pytest.raises(OSError, match="the notes are full"):
        Mine(network, DATA, session_name="cut", **OPTIONS).execute()
    assert progress("cut") == (1, 2)
    whole = Training(network, DATA, session_name="whole", **OPTIONS)
    whole.execute()
    cut = Training(network, DATA, session_name="cut", resume=True, **OPTIONS)
    cut.execute()
    assert cut.losses == whole.losses and cut.training_loss == whole.training_loss


# Not finite ---------------------------------------------------------------------------------------


class Diverging(LeastSquares):
    """Becomes NaN in its sixth step: its loss, or its parameters from then on."""

    steps, spoils = 0, "loss"

    def compute_loss(self, batch):
        loss = super().compute_loss(batch)
        self.steps += 1
        return float("nan") if self.steps == 6 and self.spoils == "loss" else loss

    def optimize(self, loss):
        super().optimize(loss)
        if self.steps >= 6 and self.spoils == "parameters":
            self._network.weights = self._network.weights * np.nan


class Spoiling(Diverging):
    spoils = "parameters"


def diverging(optimization=Diverging, **options):
    network = NetworkConfig(Linear, optimization=optimization)
    training = Training(network, DATA, **{**OPTIONS, **options})
    training.execute()
    return training


def test_nan_loss_stops_training_with_previous_checkpoint():
    with pytest.raises(
        DivergedError, match=r"^Epoch 2, batch 2: the loss is nan, though"
    ) as caught:
        diverging()
    assert (caught.value.epoch, caught.value.batch) == (2, 2)
    assert "sessions/training/network/network_0" in caught.value.__notes__[-1]
    assert progress() == (1, 1)
    with np.load("sessions/training/network/network_0/parameters.npz") as stored:
        assert np.isfinite(stored["weights"]).all()


@pytest.mark.parametrize("save_each_epoch", [False, True])
def test_nan_parameters_are_never_saved(save_each_epoch):
    network = NetworkConfig(Linear, optimization=Spoiling, save_each_epoch=save_each_epoch)
    with pytest.raises(DivergedError, match="Epoch 2, batch 3: the loss is nan, as the network's"):
        Training(network, DATA, **OPTIONS).execute()
    assert checkpoints() == (["network_0"] if save_each_epoch else [])


def test_parameters_are_checked_for_nan_before_checkpoint():
    with pytest.raises(DivergedError, match='Epoch 1: the parameter "weights" holds NaN'):
        diverging(Spoiling, epoch_nb=1, batch_size=7)  # the last of six batches spoils them
    assert checkpoints() == []


def test_nan_validation_loss_stops_training():
    DataGeneration(
        SPRING, session_name="run", new_session=False, mode="validation", batch_nb=1, batch_size=8
    ).execute()
    with pytest.raises(DivergedError, match="Epoch 1: the validation loss is nan"):
        diverging(batch_size=8)  # five batches, then the validation
    assert checkpoints() == ["network_0"]


def test_on_nan_continue_goes_on_and_says_so_once(capfd):
    training = diverging(on_nan="continue")
    assert training.epoch_id == 3 and checkpoints() == ["network_0"]
    text = 'Epoch 2, batch 2: the loss is nan; the training continues (on_nan="continue").'
    assert capfd.readouterr().err.count(text) == 1
    assert text in Path("sessions/training/info.txt").read_text()
    assert 'on_nan = "continue"' in Path("sessions/training/config.toml").read_text()
    with pytest.raises(DivergedError, match="Epoch 2, batch 3"):
        diverging(Spoiling)
    diverging(Spoiling, on_nan="continue", session_name="nan")
    with np.load("sessions/nan/network/network_0/parameters.npz") as stored:
        assert np.isnan(stored["weights"]).any()


def test_the_command_line_reports_a_divergence(capsys, tmp_path):
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom physx_core.toy import LeastSquares\n"
        "class Nan(LeastSquares):\n"
        "    def compute_loss(self, batch):\n"
        "        super().compute_loss(batch)\n"
        "        return float('nan')\n"
    )
    words = ["train", "sessions/run", "--network.network", "toy/linear", "--epoch-nb", "1"]
    words += ["--batch-size", "10", "--network.optimization", "own.py:Nan"]
    assert main(words) == 1
    assert "DivergedError: Epoch 1, batch 1: the loss is nan" in capsys.readouterr().err
    assert main([*words, "--on-nan", "continue"]) == 0
