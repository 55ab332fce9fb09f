"""Campaigns that are resumed after something about the environment was changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from physx_core import Dataset
from physx_core.cli import main

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAM = """
from physx_core import Environment, Parameter

class Case(Environment):
    episode_steps = 2

    def create(self):
        self.define_parameters([{parameters}])

    def init_database(self):
        self.define_training_fields(("x", float))

    def reset_parameters(self, **values):
        self.values = values

    def step(self):
        {line}
        self.set_training_data(x=sum(self.values.values()))
"""
P = 'Parameter("p", 0.0, 1.0)'
TYPO = "self.tpyo if self.episode_index in (1, 3) else 0"


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Return a function that writes the environment's program."""

    def write(parameters=P, line="pass"):  # of another size, as Python looks at seconds only
        (tmp_path / "case.py").write_text(PROGRAM.format(parameters=parameters, line=line))

    monkeypatch.chdir(tmp_path)
    write()
    return write


def generate(*words):
    own = ["--environment.seed", "1", "--quiet", "--session-name", "run"]
    return main(["generate", "case.py:Case", *own, *words])


def resume(*words):
    return main(["generate", "sessions/run", "--resume", *words])


def counts():
    with Dataset.open("sessions/run") as dataset:
        return dataset.num_samples("training"), len(dataset.failed_episodes("training"))


@pytest.mark.slow
def test_episodes_that_failed_by_a_mistake_are_simulated_again(write):
    generate("--episodes", "6")
    with Dataset.open("sessions/run") as dataset:
        before = dataset["training"]["x"][:].tolist()
    Path("sessions/run").rename("sessions/whole")
    write(line=TYPO)
    assert generate("--episodes", "6", "--max-failed", "5") == 0
    assert counts() == (8, 2)
    write()
    assert resume() == 0
    assert counts() == (8, 2)
    assert resume("--retry-failed") == 0
    assert counts() == (12, 0)
    with Dataset.open("sessions/run") as dataset:
        assert dataset["training"]["x"][:].tolist() == before


def test_batches_pass_over_episodes_that_failed_until_they_are_simulated_again(write):
    write(line=TYPO)
    assert generate("--batch-nb", "2", "--batch-size", "5", "--max-failed", "5") == 0
    assert counts() == (10, 2)
    write()
    assert resume("--retry-failed") == 0
    assert counts() == (10, 0)


@pytest.mark.parametrize(
    "parameters",
    ['Parameter("p", 0.0, 20.0)', f'{P}, Parameter("q", 0, 1)', 'Parameter("other", 0.0, 1.0)'],
)
def test_other_parameters_cannot_continue_a_campaign(write, capsys, parameters):
    generate("--episodes", "4")
    write(parameters=parameters)
    assert resume("--episodes", "6") == 1
    assert "the environment's parameters have changed since it began (" in capsys.readouterr().err
    assert counts() == (8, 0)


def test_traceback_of_a_failed_episode_is_shown_on_request(write, capsys):
    write(line=TYPO)
    assert generate("--episodes", "4") == 1
    said = capsys.readouterr().err
    assert "step() at step 0: AttributeError" in said
    assert "(case.py:17: self.tpyo" in said and "Traceback" not in said
    assert resume("--debug") == 1
    assert 'case.py", line' in capsys.readouterr().err


def test_second_run_of_the_same_command_says_how_to_go_on(write, capsys):
    local = ["--environment.no-as-tcp-ip-client", "--session-name", "run", "--episodes", "2"]
    for _ in range(2):
        main(["generate", "case.py:Case", *local])
    assert "to go on with the episodes of sessions/run: --resume" in capsys.readouterr().err
