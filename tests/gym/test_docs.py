"""docs/gym.md and the README of physx-gym name what there is."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from physx_gym import RobotEnv

pytestmark = [pytest.mark.slow, pytest.mark.processes]

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "gym.md"
README = ROOT / "physx_gym" / "README.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text(encoding="utf-8")


def test_the_example_of_the_readme_runs():
    [code] = [text for kind, text in BLOCK.findall(README.read_text()) if kind == "python"]
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


@pytest.mark.parametrize("path", [PAGE, README])
def test_the_tables_list_what_is_registered(path):
    assert re.findall(r"^\| `(physx/\w+-v0)`", path.read_text(), re.MULTILINE) == [
        each for each in gymnasium.registry if each.startswith("physx/")
    ]


def test_names_of_methods_exist(page):
    section = page.split("## Order of calls")[1].split("\n## ")[0]
    named = set(re.findall(r"`(_?[a-z]+(?:_[a-z]+)+)`", section))
    assert {name for name in named if not hasattr(RobotEnv, name)} == {
        "control_dt", "observe_dt", "reset_options",
    } & named  # fmt: skip
