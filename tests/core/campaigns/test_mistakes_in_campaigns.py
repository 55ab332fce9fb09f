"""What a campaign says, and what it keeps, after mistakes that concern some episodes or all."""

from __future__ import annotations

from pathlib import Path

import pytest

from physx_core import Dataset
from physx_core.cli import main

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAM = """
import sys
import numpy as np
from physx_core import Environment, Field, Parameter

class Case(Environment):
    {kind}

    def create(self):
        self.define_parameters(Parameter("p", 1.0, 2.0))

    def init_database(self):
        self.define_training_fields({field})

    def reset_parameters(self, p):
        self.p = p

    def step(self):
        x = np.full(3, self.p)
        {line}
        self.set_training_data(x=x)
"""
OPEN, CLOSED = '("x", np.ndarray)', 'Field("x", (3,))'
LOCAL, CLIENTS = "--environment.no-as-tcp-ip-client", "--environment.num-clients=2"


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Return a function that writes the environment's program."""

    def write(line="pass", field=CLOSED, kind="episode_steps = 1"):
        text = PROGRAM.format(line=line, field=field, kind=kind)
        (tmp_path / "case.py").write_text(text)

    monkeypatch.chdir(tmp_path)
    return write


def generate(where, *words, episodes=6):
    own = ["--environment.seed", "1", "--session-name", "run", "--episodes", str(episodes), where]
    return main(["generate", "case.py:Case", *own, *words])


def stored():
    """Return the numbers that have finished, and those that failed with their reasons."""
    with Dataset.open("sessions/run") as dataset:
        numbers = [each.episode for each in dataset.episodes("training") if len(each.rows)]
        failed = {each.episode: each.reason for each in dataset.failed_episodes("training")}
        return numbers, failed


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_rows_of_another_shape_fail_their_episode(write, where):
    write("x = x if self.episode_index != 3 else np.ones(4)")
    assert generate(where, "--max-failed", "5") == 0
    numbers, failed = stored()
    assert numbers == [0, 1, 2, 4, 5]
    assert list(failed) == [3]
    assert "has shape (4,) but is defined as (3,)" in failed[3]


def test_another_shape_than_an_inferred_one_names_the_episode(write, capsys):
    write("x = x if self.episode_index != 3 else np.ones(4)", OPEN)
    assert generate(LOCAL, "--max-failed", "5") == 1
    said = capsys.readouterr().err
    assert "has shape (4,) but is defined as (3,)" in said
    assert "in episode 3, with p = 1." in said


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_missing_data_name_the_episode_and_its_parameters(write, capsys, where):
    write("if self.episode_index == 3: return")
    assert generate(where) == 1
    assert "in episode 3, with p = 1." in capsys.readouterr().err


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
@pytest.mark.parametrize("kind", ["episode_steps = 1", "episode_steps = 2"])
def test_environment_that_exits_fails_its_episode(write, where, kind):
    write("if self.episode_index == 3: sys.exit('licence')", kind=kind)
    assert generate(where, "--max-failed", "1") == 0
    numbers, failed = stored()
    assert numbers == [0, 1, 2, 4, 5]
    assert "case.py" in failed[3]
    assert "SystemExit('licence')" in failed[3]


def test_campaign_without_rows_warns(write):
    write("self.end_episode(); return", kind="independent_episodes = True")
    with pytest.warns(UserWarning, match="without a row"):
        assert generate(LOCAL) == 0


def test_smaller_number_leaves_the_larger_one_to_be_resumed(write):
    write("assert self.episode_index < 4")
    assert generate(CLIENTS, episodes=9) == 1
    write("self.p += 1")
    assert main(["generate", "sessions/run", "--resume", "--episodes", "2"]) == 0
    assert main(["generate", "sessions/run", "--resume", "--retry-failed"]) == 0
    assert stored() == ([*range(9)], {})


def test_run_that_was_killed_at_its_start_cannot_be_resumed(write, capsys):
    Path("sessions/run").mkdir(parents=True)
    assert main(["generate", "sessions/run", "--resume"]) == 1
    said = capsys.readouterr().err
    assert "ended before it began" in said
    assert "without --resume" in said


# Saved parameters --------------------------------------------------------------------------------

SAVING = """
from physx_core import Environment

class Case(Environment):
    episode_steps = 2

    def init_database(self):
        self.define_training_fields(("x", float))

    def create(self):
        {create}

    def step(self):
        {step}
        self.set_training_data(x=self.load_parameters().get("mean", -1.0))
"""


def save(create="pass", step="pass"):
    Path("case.py").write_text(SAVING.format(create=create, step=step))


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_instances_of_a_campaign_have_the_same_saved_parameters(write, where):
    save("self.save_parameters(mean=2.5)")
    assert generate(where) == 0
    with Dataset.open("sessions/run") as dataset:
        assert dataset["training"]["x"][:].tolist() == [2.5] * 12
    assert [path.name for path in Path("sessions/run/dataset").glob("*.bin")] == [
        "parameters_0.bin"
    ]


def test_instances_that_save_others_end_the_campaign(write, capsys):
    save("self.save_parameters(mean=self.instance_id)")
    assert generate(CLIENTS) == 1
    assert 'save_parameters() got another value of "mean"' in capsys.readouterr().err


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_parameters_cannot_be_saved_in_an_episode(write, capsys, where):
    save(step="self.save_parameters(mean=2.0)")
    assert generate(where) == 1
    said = capsys.readouterr().err
    assert "called save_parameters() in an independent episode" in said
