"""docs/gym.md: its files are written, and its code runs as a program."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from physx_core.config import read_toml
from physx_gym import RobotEnv, read_log

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "gym.md"
README = ROOT / "physx_gym" / "README.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text(encoding="utf-8")


_KINDS = ["python", "python", "toml", "python", "toml", *["python"] * 8]


def test_all_code_of_the_page_runs(page, tmp_path):
    blocks = [(kind, text) for kind, text in BLOCK.findall(page)]
    assert [kind for kind, _ in blocks] == ["xml", *_KINDS]
    for kind, text in blocks:
        if kind == "xml":
            (tmp_path / "swing.urdf").write_text(text, encoding="utf-8")
        if kind == "toml":
            with (tmp_path / "walker.toml").open("a", encoding="utf-8") as file:
                file.write(text)
    code = [text for kind, text in blocks if kind == "python" and "render_mode" not in text]
    (tmp_path / "page.py").write_text("\n".join(code), encoding="utf-8")
    variables = {key: each for key, each in os.environ.items() if "DISPLAY" not in key}
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=tmp_path,
        env={**variables, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "steps: " in done.stdout
    for name in ("swing.png", "both.png", "swing.rrd"):
        assert (tmp_path / name).stat().st_size > 1000
    assert len(read_log(tmp_path / "swing.h5").time) == 3
    assert len(read_toml(tmp_path / "walker.toml")["layers_config"]) == 5


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
