"""What a run says on stderr, and which session it leaves, or does not leave, behind."""

from __future__ import annotations

import re
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
    Prediction,
    Replay,
    Training,
    View,
    Visualizer,
)
from physx_core.cli import main
from physx_core.errors import (
    DatasetError,
    DatasetNotFoundError,
    EnvironmentFailedError,
    PhysxError,
    WrongSamplesError,
)

ALL = View(hold_back=False)

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
LINEAR = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})


def generate(environment=SPRING, **options):
    options = {"session_name": "spring", "batch_nb": 2, "batch_size": 10, **options}
    pipeline = DataGeneration(environment, **options)
    pipeline.execute()
    return pipeline


def train(source, view=ALL, **options):
    data = DatasetConfig(existing_dir=source, view=view)
    pipeline = Training(LINEAR, data, epoch_nb=2, batch_size=5, **options)
    pipeline.execute()
    return pipeline


def sessions():
    return sorted(path.name for path in Path("sessions").iterdir())


@pytest.fixture
def said(capsys):
    """Return the lines that were printed on stderr since the last call; none was on stdout."""

    def read():
        text = capsys.readouterr()
        assert text.out == ""
        text = re.sub(r"\d+\.\d\d s, \d+ samples/s", "T", text.err)
        return re.sub(r"in \d+\.\d\d s", "in T", text).splitlines()

    return read


# Announcements ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (3, "3 samples to train on, 0 held back for validation: a piece of the only block"),
        (20, "16 samples to train on, 4 held back for validation: a piece of the only trajectory"),
        (30, "24 samples to train on, 6 held back for validation: 1 of 5 trajectories"),
    ],
)
def test_a_training_says_what_it_holds_back(said, rows, words):
    n = np.arange(rows)
    known = {"episode": n // (20 if rows == 20 else 6), "env_id": np.ones(rows, int), "step": n}
    with Dataset.create("data") as dataset:
        state = {name: np.ones((rows, 2)) for name in ("state", "next_state", "force")}
        dataset.append("training", state | (known if rows > 3 else {}))
    train("data", View())
    assert words in said()


def test_a_generation_says_where_it_writes_what_it_left_and_how_to_continue(said):
    generate()
    end = ["2 of 2 batches in T", "samples: 20 training in sessions/{0}/dataset"]
    info, training = (
        "next: physx info sessions/{0}",
        "next: physx train sessions/{0} --network.network NETWORK --epoch-nb N --batch-size N",
    )
    expected = [line.format("spring") for line in (*end, info, training)]
    assert said() == ["session: sessions/spring", *expected]
    generate()
    expected = [line.format("spring_1") for line in (*end, info, training)]
    assert said() == ['session: sessions/spring_1 ("spring" exists)', *expected]
    with pytest.warns(UserWarning, match='session "spring", but "spring_1" is newer'):
        generate(new_session=False, mode="validation")
    lines = said()
    assert lines[0] == "session: sessions/spring (continued)"
    assert lines[2] == "samples: 20 training, 20 validation in sessions/spring/dataset"


def test_a_training_names_its_samples_its_losses_and_its_files(said):
    made = generate().session.path
    said()
    training = train(made)
    assert said() == [
        "session: sessions/training",
        "samples: 20 training in sessions/spring/dataset",
        "2 of 2 epochs in T",
        f"training loss {training.training_loss:.6g}",
        f"smallest training loss {training.best.loss:.6g}, after epoch {training.best.epoch}",
        "checkpoint: sessions/training/network/network_0",
        'not judged: no samples were held back: generate some of the mode "validation", or hold '
        "back a part of stored ones (View.hold_back)",
        "statistics: sessions/training/stats/scalars.csv",
        "next: physx predict sessions/training ENVIRONMENT --step-nb N",
        "next: physx stats sessions/training",
    ]


def test_a_prediction_and_a_replay_say_what_they_left(said):
    made = train(generate().session.path).session
    said()
    options = {"session_name": made.name, "step_nb": 3}
    Prediction(NetworkConfig(), SPRING, **options).execute()
    assert said() == ["session: sessions/training (continued)", "3 steps with toy/linear"]
    Prediction(NetworkConfig(), SPRING, record=True, **options).execute()
    assert said()[2:] == [
        "samples: 3 prediction in sessions/training/dataset",
        "next: physx info sessions/training",
    ]
    Replay(DatasetConfig(existing_dir="sessions/spring", view=ALL), SPRING).execute()
    assert said() == ["session: sessions/replay", "20 steps of toy/spring"]


UNUSED = (
    "nothing used the predictions: the environment does not define apply_prediction, and record "
    "(--record) is off"
)


class Deaf(Environment):
    """Does nothing with predictions, unless it asks for them."""

    def __init__(self, *, asks=False, **kwargs):
        super().__init__(**kwargs)
        self.asks = asks

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([("state", np.ndarray), ("force", np.ndarray)])

    def step(self):
        inputs = {"state": np.ones(2), "force": np.ones(1)}
        if self.asks:
            self.get_prediction(**inputs)
        self.set_training_data(**inputs)


class Breaks(Deaf):
    def step(self):
        if self.step_index:
            raise ValueError("broken")
        super().step()


class Hears(Deaf):
    def apply_prediction(self, prediction):
        self.prediction = prediction


class Prints(Prediction):
    """Does something with predictions itself."""

    def sample_end(self):
        assert self.prediction


def test_a_prediction_that_nothing_uses_says_so(said):
    train(generate().session.path)
    said()

    def lines(environment, make=Prediction, record=False, **options):
        config = EnvironmentConfig(environment, as_tcp_ip_client=False, env_kwargs=options)
        make(NetworkConfig(), config, step_nb=2, record=record).execute()
        return said()

    assert lines(Deaf)[1:] == ["2 steps with toy/linear", UNUSED]
    for used in (lines(Hears), lines(Deaf, asks=True), lines(Deaf, Prints)):
        assert used[1:] == ["2 steps with toy/linear"]
    assert UNUSED not in lines(Deaf, record=True)


def test_a_prediction_without_an_end_says_how_it_ends(said):
    train(generate().session.path)
    said()

    class Interrupted(Prediction):
        def sample_end(self):
            signal.raise_signal(signal.SIGINT)

    Interrupted(NetworkConfig(), SPRING).execute()
    assert said()[1] == "runs until Ctrl-C; step_nb (--step-nb) limits the number of steps"


def test_a_batch_that_is_larger_than_the_dataset_is_announced(said):
    made = generate().session.path
    said()
    data = DatasetConfig(existing_dir=made, view=ALL)
    Training(LINEAR, data, epoch_nb=1, batch_size=21).execute()
    assert said()[2] == "batches of 20 samples, because there are no more"
    Training(LINEAR, data, epoch_nb=1, batch_size=20).execute()
    assert not any("no more" in line for line in said())


def test_what_is_known_only_in_a_run_says_so_before():
    pipeline = DataGeneration(SPRING, session_name="spring", batch_nb=1, batch_size=1)
    with pytest.raises(AttributeError, match="'session' yet: .* call execute"):
        _ = pipeline.session
    with pytest.raises(AttributeError, match="no attribute 'sesion'$"):
        _ = pipeline.sesion
    pipeline.execute()
    assert pipeline.session.path.is_dir()


class Filming(Visualizer):
    """Has a screen, leaves a film, and fails afterwards if asked."""

    def __init__(self, fails=False):
        self.fails = fails

    def open(self, run_name, session_dir, instance_nb):
        self.screen = f"screen: of {run_name}"

    def announcements(self):
        return [self.screen]

    def close(self):
        if self.fails:
            raise RuntimeError("no screen")

    def outputs(self):
        return ["film: there.gif"]


@pytest.mark.parametrize("fails", [False, True])
def test_a_visualizer_announces_its_screen_and_its_files_even_if_it_failed(fails, said):
    config = EnvironmentConfig(
        "toy/spring",
        as_tcp_ip_client=False,
        visualizer=Filming,
        visualizer_kwargs={"fails": fails},
    )
    if fails:
        with pytest.warns(UserWarning, match="Filming failed"):
            generate(config)
    else:
        generate(config)
    lines = said()
    assert lines[:2] == ["session: sessions/spring", "screen: of spring"]
    assert "film: there.gif" in lines


def test_a_prediction_that_failed_is_not_said_to_be_unused(said):
    train(generate().session.path)
    said()
    config = EnvironmentConfig(Breaks, as_tcp_ip_client=False, visualizer=Filming)
    with pytest.raises(EnvironmentFailedError):
        Prediction(NetworkConfig(), config, step_nb=2).execute()
    lines = said()
    assert "film: there.gif" in lines and UNUSED not in lines


def test_a_quiet_run_says_nothing(said):
    made = generate(quiet=True).session.path
    network = train(made, quiet=True).session
    Prediction(NetworkConfig(), SPRING, session_name=network.name, step_nb=2, quiet=True).execute()
    Replay(DatasetConfig(existing_dir=made, view=ALL), SPRING, quiet=True).execute()
    words = ["generate", "toy/spring", "--batch-nb", "1", "--batch-size", "2", "--quiet"]
    assert main([*words, "--environment.no-as-tcp-ip-client"]) == 0
    assert said() == []
    assert "quiet" not in Path("sessions/spring/config.toml").read_text()


@pytest.mark.parametrize(
    "closing",
    ["sys.stderr.close()", "sys.stderr = None", "r, w = os.pipe(); os.close(r); os.dup2(w, 2)"],
)
def test_a_closed_stderr_does_not_end_a_run(closing):
    code = (
        f"import os, sys; {closing}\n"
        "from physx_core import *\n"
        "DataGeneration(EnvironmentConfig('toy/spring', as_tcp_ip_client=False),\n"
        "               batch_nb=1, batch_size=3).execute()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    with Dataset.open("sessions/data_generation") as dataset:
        assert dataset.num_samples("training") == 3


# Sessions of runs that failed -------------------------------------------------------------------


class Fails(Environment):
    """Raises an error in a step; `keeps` makes it leave something before."""

    def __init__(self, *, at=0, error="ValueError", keeps=False, **kwargs):
        super().__init__(**kwargs)
        self.at, self.error, self.keeps = at, error, keeps

    def create(self):
        pass

    def init_database(self):
        if self.keeps:
            self.save_parameters(stiffness=3.0)
        self.define_training_fields([("state", np.ndarray), ("next_state", np.ndarray)])

    def step(self):
        if self.step_index == self.at:
            raise {"ValueError": ValueError, "KeyboardInterrupt": KeyboardInterrupt}[self.error]
        self.set_training_data(state=np.zeros(2), next_state=np.ones(2))

    def check_sample(self):
        return self.error != "refused"


def failing(**options):
    return EnvironmentConfig(Fails, env_kwargs=options, as_tcp_ip_client=False)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({}, EnvironmentFailedError),
        ({"at": 9}, EnvironmentFailedError),
        ({"error": "KeyboardInterrupt"}, KeyboardInterrupt),
        ({"at": 99, "error": "refused"}, WrongSamplesError),
    ],
)
def test_a_run_that_failed_before_its_first_row_leaves_no_session(options, error, said):
    with pytest.raises(error):
        generate(failing(**options))
    assert sessions() == []
    assert said() == [
        "session: sessions/spring",
        "session: sessions/spring was removed: the run stored nothing in it",
    ]
    assert generate().session.name == "spring"


def test_neither_does_one_whose_own_code_fails_while_it_is_open():
    pipeline = DataGeneration(SPRING, session_name="spring", batch_nb=1, batch_size=1)
    with pytest.raises(ZeroDivisionError), pipeline:
        raise ZeroDivisionError
    assert sessions() == []
    with pipeline:
        pass
    assert sessions() == ["spring"]


class Loses(Training):
    def optimize(self):
        if self.batch_id or self.epoch_id:
            super().optimize()
        raise ZeroDivisionError


def test_neither_does_a_training_without_a_batch(said):
    made = generate().session.path
    data = DatasetConfig(existing_dir=made, view=ALL)
    with pytest.raises(ZeroDivisionError):
        Loses(LINEAR, data, epoch_nb=1, batch_size=5).execute()
    assert sessions() == ["spring"]


def test_rows_survive_a_failure_and_are_announced(said):
    with pytest.raises(EnvironmentFailedError):
        generate(failing(at=15))
    assert "samples: 10 training in sessions/spring/dataset" in said()
    with Dataset.open("sessions/spring") as dataset:
        assert dataset.num_samples("training") == 10


class Draws(Visualizer):
    """Leaves a file in the session, as a recording does."""

    def open(self, run_name, session_dir, instance_nb):
        (session_dir / "drawn.bin").write_bytes(b"x")


def leave_notes():
    info = Path("sessions/spring/info.txt")
    info.write_text(info.read_text().replace("(Write here", "Mine. (Write here"))


@pytest.mark.parametrize("what", ["parameters", "recording", "notes", "file", "dataset file"])
def test_a_session_that_holds_anything_stays(what):
    class Leaves(DataGeneration):
        def batch_begin(self):
            if what == "notes":
                leave_notes()
            if what == "file":
                (self.session.path / "mine.txt").write_text("")
            if what == "dataset file":
                (self.session.dataset_dir / "mine.csv").write_text("")

    config = EnvironmentConfig(
        Fails,
        env_kwargs={"keeps": what == "parameters"},
        as_tcp_ip_client=False,
        visualizer=Draws if what == "recording" else None,
    )
    with pytest.raises(EnvironmentFailedError):
        Leaves(config, session_name="spring", batch_nb=1, batch_size=1).execute()
    assert sessions() == ["spring"]


def test_a_session_that_existed_before_stays():
    Path("sessions/spring").mkdir(parents=True)
    with pytest.raises(EnvironmentFailedError):
        generate(failing(), new_session=False)
    assert sessions() == ["spring"]


def test_ctrl_c_before_the_first_row_leaves_no_session(tmp_path):
    script = tmp_path / "slow.py"
    script.write_text(
        "import time\n"
        "from pathlib import Path\n"
        "from physx_core import *\n"
        "class Slow(Environment):\n"
        "    def create(self): pass\n"
        "    def init_database(self): self.define_training_fields([('x', float)])\n"
        "    def step(self):\n"
        "        Path('stepping').touch()\n"
        "        time.sleep(60)\n"
        "if __name__ == '__main__':\n"
        "    DataGeneration(EnvironmentConfig(Slow), batch_nb=1, batch_size=1).execute()\n"
    )
    process = subprocess.Popen([sys.executable, script], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not Path("stepping").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, text = process.communicate(timeout=60)
    assert "session: sessions/data_generation was removed" in text
    assert sessions() == []


# Sessions of the same name ----------------------------------------------------------------------


def test_a_name_that_was_numbered_since_is_used_with_a_warning():
    generate()
    generate()
    train("sessions/spring", session_name="net")
    second = train("sessions/spring_1", session_name="net")
    assert second.session.name == "net_1"
    with pytest.warns(UserWarning, match='session "net", but "net_1" is newer.*session_name='):
        Prediction(NetworkConfig(), SPRING, session_name="net", step_nb=1).execute()
    Prediction(NetworkConfig(), SPRING, session_name="net", step_nb=1).execute()  # now the newest
    Prediction(NetworkConfig(), SPRING, session_name="net_1", step_nb=1).execute()


def test_commands_warn_on_one_line(tmp_path):
    generate()
    generate()
    words = ["physx_core", "generate", "toy/spring", "--session-name", "spring", "--no-new-session"]
    done = subprocess.run(
        [sys.executable, "-m", *words, "--batch-nb", "1", "--batch-size", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    (line,) = (line for line in done.stderr.splitlines() if "is newer" in line)
    assert line.startswith('physx: UserWarning: Using the session "spring", but "spring_1" is')
    assert ".py" not in done.stderr


def test_a_missing_session_is_not_continued_in_silence():
    generate()
    generate()
    Path("sessions/spring").rename("sessions/away")
    with pytest.warns(UserWarning, match='no session "spring": using a new one, not spring_1'):
        generate(new_session=False)


def test_missing_samples_are_looked_for_in_the_sessions_of_that_name():
    generate()
    generate()
    generate(new_session=False, session_name="spring_1", mode="validation")
    data = DatasetConfig(existing_dir="sessions/spring", mode="validation")
    found = r"such samples in sessions/spring_1 \(20\)"
    with pytest.raises(DatasetError, match=found):
        Training(LINEAR, data, epoch_nb=1, batch_size=1).execute()
    with pytest.raises(DatasetError, match=found):
        Replay(data, SPRING).execute()
    Path("sessions/spring/dataset").rename("sessions/spring/away")
    with pytest.warns(UserWarning), pytest.raises(DatasetNotFoundError) as caught:
        Training(
            LINEAR, None, session_name="spring", new_session=False, epoch_nb=1, batch_size=1
        ).execute()
    assert "sessions/spring_1 (20)" in caught.value.__notes__[0]


# The command line -------------------------------------------------------------------------------


def interrupted_training():
    """A session whose training was interrupted after an epoch."""

    class Interrupted(Training):
        def epoch_end(self):
            super().epoch_end()
            signal.raise_signal(signal.SIGINT)

    data = DatasetConfig(existing_dir=generate().session.path)
    with pytest.raises(KeyboardInterrupt):
        Interrupted(LINEAR, data, epoch_nb=3, batch_size=5, seed=4).execute()


def test_resuming_needs_nothing_but_the_session(said):
    interrupted_training()
    assert said()[-1] == "next: physx train sessions/training --resume"
    assert main(["train", "sessions/training", "--resume"]) == 0
    lines = said()
    assert lines[0] == "session: sessions/training (continued)"
    assert "3 of 3 epochs in T" in lines
    assert main(["train", "sessions/training/", "--resume", "--epoch-nb", "4"]) == 0
    assert "4 of 4 epochs in T" in said()
    assert main(["train", "sessions/training", "--resume"]) == 0
    assert any(line.startswith("nothing left to train") for line in said())
    assert sessions() == ["spring", "training"]


def test_a_session_is_a_configuration_file(said):
    generate()
    assert main(["generate", "--config", "sessions/spring"]) == 0
    assert main(["generate", "--config=sessions/spring", "--batch-nb", "1"]) == 0
    assert sessions() == ["spring", "spring_1", "spring_2"]


ONE = ["--batch-nb", "1", "--batch-size", "1", "--environment.no-as-tcp-ip-client"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "sessions/none", "--resume"], 'no session "none" in sessions'),
        (["train", "sessions/spring", "--resume"], "config.toml has no table [training]"),
        (["train", "sessions/empty", "--resume"], "sessions/empty ended before it began"),
        (["train", "--config", "sessions/spring"], "It has: data_generation."),
        (["train", "--config", "sessions"], "There is no configuration file sessions/config.toml"),
        (["train", "--config", "odd"], "odd/config.toml cannot be read: Is a directory"),
        (["train", "--config", "flat.toml"], 'The option "dataset" of the table [training]'),
        (["train", "sessions/spring", "sessions/spring"], "Unexpected argument"),
        (["stats", "sessions/spring"], "has no statistics"),
        (["stats", "sessions/none"], "There is no sessions/none/stats/scalars.csv"),
        (["verify", "flat.toml"], "It is a file"),
        (["info", "flat.toml"], "It is a file"),
        (["predict", "sessions/spring", "toy/spring"], "There is no network in sessions/spring"),
        (["predict", "flat.toml", "toy/spring"], 'no session "flat.toml"'),
        (["generate", "toy/sprint", *ONE], 'mean "spring"'),
        (["generate", "flat.py:Nothing", *ONE], "has: Mine."),
    ],
)  # fmt: skip
def test_mistakes_are_one_clear_line(words, message, capsys):
    generate()
    Path("sessions/empty").mkdir()
    Path("odd/config.toml").mkdir(parents=True)
    Path("flat.toml").write_text("[training]\ndataset = 'sessions/spring'\n")
    Path("flat.py").write_text(
        "from physx_core import *\nclass Mine(Environment): pass\nclass Other: pass\n"
    )
    capsys.readouterr()
    assert main(words) == 1
    line, *others = capsys.readouterr().err.splitlines()
    assert message in line and line.startswith("physx: ") and not others


def test_the_only_name_in_a_session_is_that_of_the_network():
    made = generate().session.path
    named = NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": ["state", "force"]}, network_name="line"
    )
    Training(named, DatasetConfig(existing_dir=made, view=ALL), epoch_nb=1, batch_size=5).execute()
    Prediction(NetworkConfig(), SPRING, step_nb=1).execute()
    other = NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": ["state", "force"]}, network_name="other"
    )
    data = DatasetConfig(existing_dir=made, view=ALL)
    Training(other, data, new_session=False, epoch_nb=1, batch_size=5).execute()
    with pytest.raises(PhysxError, match="Available: line_0, other_0"):
        Prediction(NetworkConfig(), SPRING, step_nb=1).execute()
