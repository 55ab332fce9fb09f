"""What commands print fits into 80 columns, also where it is piped."""

from pathlib import Path

import pytest
from wide_lines import wide_lines

from physx_core.cli import main, show_table
from physx_core.plugins import find_entries

CLOTH = """
from physx_core import Environment, Field, Parameter

STIFFNESS = "bending_stiffness_of_the_cloth"
CORNER, MIDDLE = "position_of_the_corner_of_the_cloth", "next_velocity_of_the_middle"

class Cloth(Environment):
    episode_steps = 10
    def create(self):
        self.define_parameters([Parameter(STIFFNESS, 5.0, 30.0, unit="N/m")])
    def init_database(self):
        self.define_training_fields([Field(CORNER, (2,), unit="m"), Field(MIDDLE, (2,))])
    def reset_parameters(self, **values):
        self.stiffness = values[STIFFNESS]
        self.place = self.rng.uniform(0.5, 1.0, 2)
    def step(self):
        speed = -self.stiffness * self.place
        self.set_training_data(**{CORNER: self.place, MIDDLE: speed})
        self.place = self.place + 0.01 * speed
"""
GENERATE = (
    "generate cloth.py:Cloth --episodes 40 --session-name cloth --environment.no-as-tcp-ip-client"
)
TRAIN = (
    "train sessions/cloth --network.network toy/linear --network.network-kwargs "
    "net_fields=position_of_the_corner_of_the_cloth opt_fields=next_velocity_of_the_middle "
    "--epoch-nb 2 --batch-size 20 --session-name learned"
)


def printed(capsys, command):
    """Return what a command prints to a pipe, on both streams."""
    assert main(command.split()) == 0
    text = capsys.readouterr()
    return text.out + text.err


def test_every_line_of_a_command_fits(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    Path("cloth.py").write_text(CLOTH)
    for command, said in (
        (GENERATE, "--epoch-nb N \\\n    --batch-size N"),
        (TRAIN, "nearest neighbor  rmse"),
        ("info sessions/cloth", "bending_stiffness_of_the_cloth"),
        ("info sessions/learned", "nearest neighbor  rmse"),
        ("stats sessions/learned", "loss/training_variance"),
        ("verify sessions/cloth", "sound"),
        ("verify sessions/learned/network/network_0", "as recorded"),
        ("evaluate sessions/learned", "next_velocity_of_the_middle"),
    ):
        text = printed(capsys, command)
        assert said in text and wide_lines(text) == [], command


@pytest.mark.parametrize(("columns", "lines"), [("60", 2), ("200", 1)])
def test_a_line_is_as_long_as_the_terminal_is_wide(capsys, monkeypatch, columns, lines):
    monkeypatch.setenv("COLUMNS", columns)
    Path("cloth.py").write_text(CLOTH)
    [_, command] = printed(capsys, GENERATE).split("\nnext: physx train ")
    assert len(command.splitlines()) == lines


@pytest.mark.parametrize("command", sorted(find_entries("physx.commands")))
def test_help_fits(capsys, monkeypatch, command):
    monkeypatch.delenv("COLUMNS", raising=False)
    text = printed(capsys, f"{command} --help")
    assert text.startswith(f"usage: physx {command}") and wide_lines(text) == []


def test_a_table_that_is_too_wide_breaks_between_words(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "58")
    head = ["pipeline", "lr", "layers", "state", "loss/validation", ""]
    row = ["linear", "0.002288", "[5, 256, 256, 256, 576]", "complete", "0.32577", "█▆▃"]
    show_table(head, [row], numbers=("lr", "loss/validation"), curve="")
    text = capsys.readouterr().out
    assert {"linear", "0.002288", "576]", "complete", "0.32577"} <= set(text.split())
    assert max(map(len, text.splitlines())) <= 58


def test_a_description_breaks_only_where_the_terminal_ends(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    text = printed(capsys, "verify --help")
    assert 'left open, and move unreadable partitions to the folder "damaged".' in text
