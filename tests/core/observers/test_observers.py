"""Observers: the file of numbers, and that a failing one ends nothing."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Observer
from physx_core import Training as PhysxTraining
from physx_core.cli import main
from physx_core.cli.commands.stats import spark_line
from physx_core.errors import SessionError
from physx_core.observers import Observers, ScalarsFile, read_scalars

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)


@pytest.fixture
def written(tmp_path):
    """Return a function that writes numbers to the file of a session, as a run does."""

    def write(*numbers, close=True):
        file = ScalarsFile()
        file.open("run", tmp_path, 0)
        for timeline, step, values in numbers:
            file.scalars(values, step, timeline)
        if close:
            file.close()
        return tmp_path

    return write


def test_numbers_are_read_as_they_were_written(written):
    values = {"loss/batch": 0.1 + 0.2, "a, b": math.inf}
    found = read_scalars(written(("batch", 1, values), ("epoch", 1, {"x": 1e-300})))
    assert found == {
        ("batch", "loss/batch"): {1: 0.1 + 0.2},
        ("batch", "a, b"): {1: math.inf},
        ("epoch", "x"): {1: 1e-300},
    }


def test_the_numbers_of_an_epoch_are_in_the_file_at_once(written):
    folder = written(("batch", 1, {"x": 1.0}), ("epoch", 1, {"y": 2.0}), close=False)
    assert len(read_scalars(folder)) == 2


def test_a_resumed_run_adds_to_the_file_and_repeated_steps_count_once(written):
    folder = written(("epoch", 1, {"x": 1.0}), ("epoch", 2, {"x": 2.0}))
    path = folder / "stats" / "scalars.csv"
    with path.open("a") as stream:
        stream.write("epoch,3,x,0.")  # what a killed run wrote of its last line
    assert read_scalars(folder) == {("epoch", "x"): {1: 1.0, 2: 2.0}}
    written(("epoch", 2, {"x": 5.0}), ("epoch", 3, {"x": 6.0}))
    assert read_scalars(folder) == {("epoch", "x"): {1: 1.0, 2: 5.0, 3: 6.0}}
    assert path.read_text().count("timeline") == 1


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "timeline,step,name,value\nepoch,1,x,much\n"])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "stats").mkdir()
    (tmp_path / "stats" / "scalars.csv").write_text(text)
    with pytest.raises(SessionError, match="scalars.csv"):
        read_scalars(tmp_path)


def test_a_killed_run_keeps_its_numbers(tmp_path):
    script = tmp_path / "endless.py"
    script.write_text(
        "from physx_core import *\n"
        "spring = EnvironmentConfig('toy/spring', as_tcp_ip_client=False)\n"
        "Training(NetworkConfig('toy/linear'), None, spring,\n"
        "         epoch_nb=10**6, batch_nb=10, batch_size=10).execute()\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.DEVNULL)
    session, deadline = tmp_path / "sessions" / "training", time.monotonic() + 60
    path = session / "stats" / "scalars.csv"
    while not (path.exists() and path.stat().st_size > 20_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=60)
    epochs = read_scalars(session)["epoch", "loss/training"]
    assert list(epochs) == list(range(1, len(epochs) + 1)) and len(epochs) > 5
    batches = read_scalars(session)["batch", "loss/batch"]
    assert len(batches) >= 10 * len(epochs)


def test_a_resumed_training_has_the_numbers_of_all_batches(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(
        "import os, sys\n"
        "from physx_core import *\n"
        "class Killed(Training):\n"
        "    def batch_begin(self):\n"
        "        if self.batch_id in (3, 8) and self.batch_id > self._resumed.batch:\n"
        "            os.kill(os.getpid(), 9)\n"
        "spring = EnvironmentConfig('toy/spring', as_tcp_ip_client=False)\n"
        "Killed(NetworkConfig('toy/linear'), None, spring, epoch_nb=1, batch_nb=10,\n"
        "       batch_size=10, checkpoint_every=1, new_session='resume' not in sys.argv,\n"
        "       resume='resume' in sys.argv).execute()\n"
    )
    for words, status in (([], -9), (["resume"], -9), (["resume"], 0)):
        command = [sys.executable, str(script), *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr
    found = read_scalars(tmp_path / "sessions" / "training")
    assert list(found["batch", "loss/batch"]) == list(range(1, 11))


# Failing observers ------------------------------------------------------------------------------

METHODS = ["begin", "advance", "end", "scalars", "histograms", "flush", "note", "events", "close"]


def failing(*methods):
    """Return a class of observers that raise in some methods."""

    def fail(self, *args):
        raise RuntimeError("on purpose")

    return type("Fails", (Observer,), dict.fromkeys(methods, fail))


@pytest.mark.parametrize("method", METHODS)
def test_one_that_fails_is_left_out_and_the_others_go_on(method):
    seen = []

    class Sees(Observer):
        def __getattribute__(self, name):
            if name in METHODS:
                seen.append(name)
            return super().__getattribute__(name)

    observers = Observers([failing(method)(), Sees()])
    arguments = {
        "begin": ("training", 3, "batches"),
        "advance": (1,),
        "scalars": ({"x": 1.0}, 1, "batch"),
        "histograms": ({}, 1, "epoch"),
        "note": ("text",),
        "events": (1, 0, []),
    }.get(method, ())
    with pytest.warns(UserWarning, match="Fails failed and is disabled.*on purpose"):
        getattr(observers, method)(*arguments)
    getattr(observers, method)(*arguments)
    assert seen == [method, method]


@pytest.mark.parametrize("returned", [None, "a text", 3, {"a": "set"}.keys()])
@pytest.mark.parametrize("method", ["announcements", "outputs", "touch"])
def test_one_that_returns_no_list_fails(method, returned):
    bad = type("Bad", (Observer,), {method: lambda self, *arguments: returned})
    good = type("Good", (Observer,), {method: lambda self, *arguments: ["said"]})
    observers = Observers([bad(), good()])
    arguments = [1] if method == "touch" else []
    with pytest.warns(UserWarning, match=rf"Bad failed.*{method}\(\) returned .*, not a list"):
        assert list(getattr(observers, method)(*arguments)) == ["said"]


def test_a_training_goes_on_without_those_that_fail():
    DataGeneration(SPRING, batch_nb=1, batch_size=20, session_name="run").execute()
    data = DatasetConfig(existing_dir="sessions/run")
    pipeline = PhysxTraining(
        NetworkConfig("toy/linear"),
        data,
        epoch_nb=2,
        batch_size=5,
        statistics=[failing("scalars"), failing("histograms"), failing("close")],
        histograms_every=1,
    )
    with pytest.warns(UserWarning, match="disabled") as told:
        pipeline.execute()
    assert pipeline.epoch_id == 2
    assert sum("Fails failed" in str(warning.message) for warning in told) == 3
    assert len(read_scalars(pipeline.session.path)["epoch", "loss/training"]) == 2


# physx stats ------------------------------------------------------------------------------------


def test_the_table(written, capsys):
    losses = [("epoch", step, {"loss/training": 2.0**-step}) for step in range(1, 17)]
    folder = written(*losses, ("epoch", 17, {"loss/training": math.nan, "other": 1.0}))
    assert main(["stats", str(folder)]) == 0
    head, loss, other = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "per", "number", "last", "min", "max", "mean"]
    assert loss.split()[:4] == ["loss/training", "epoch", "17", "nan"]
    assert loss.split()[-1] == "██▇▇▆▆▅▅▄▄▃▃▂▂▁▁x"
    assert other.split()[-2:] == ["1", "▁"]


def test_spark_lines():
    assert spark_line([0, 1, 2, 3, 4, 5, 6, 7], 8) == "▁▂▃▄▅▆▇█"
    assert spark_line([1, 10, 100, 1000], 4) == "▁▃▆█"
    assert spark_line([1, 3, 5, 7], 2) == "▁█"
    assert spark_line([5, 5, math.nan], 9) == "▁▁x"
    assert spark_line([], 9) == ""


def test_sessions_without_numbers(tmp_path, capsys):
    assert main(["stats", str(tmp_path)]) == 1
    assert "scalars.csv" in capsys.readouterr().err
    Path("stats").mkdir()
    assert main(["stats", str(tmp_path), "--tensorboard"]) == 1
    assert "torch/tensorboard" in capsys.readouterr().err


def test_the_command_line_takes_where_numbers_go(capsys):
    DataGeneration(SPRING, batch_nb=1, batch_size=20, session_name="run").execute()
    assert main(["train", "--help"]) == 0
    assert "--statistics" in capsys.readouterr().out
    Path("seen.py").write_text(
        "from pathlib import Path\nfrom physx_core import Observer\n\nclass Sees(Observer):\n"
        "    def __init__(self, name): self.name = name\n"
        "    def histograms(self, values, step, timeline): Path(self.name).write_text(timeline)\n"
    )
    words = [
        "--network.network",
        "toy/linear",
        "--epoch-nb",
        "1",
        "--batch-size",
        "5",
        "--histograms-every",
        "1",
    ]
    chosen = ["--statistics", "seen.py:Sees", "--statistics-kwargs"]
    for name, table in (("toml", "{name='toml'}"), ("json", '{"name": "json"}')):
        assert main(["train", "sessions/run", *words, *chosen, f"seen.py:Sees={table}"]) == 0
        assert Path(name).read_text() == "epoch"
    capsys.readouterr()
    for nonsense in ("5", '{"name"', "name"):
        assert main(["train", "sessions/run", *words, *chosen, f"seen.py:Sees={nonsense}"]) == 1
        assert "The statistics_kwargs of seen.py:Sees are " in capsys.readouterr().err
