"""The programs and commands of README.md and docs/migration.md run as printed."""

import re
import shlex

import pytest

pytest.importorskip("torch")


@pytest.fixture
def block(root):
    """Return the code block of a page that begins with a text."""

    def find(page, beginning):
        found = re.findall(r"```\w*\n(.*?)```", (root / page).read_text(), re.S)
        return next(code for code in found if code.startswith(beginning))

    return find


def test_the_pendulum_and_its_commands(block, run, tmp_path):
    (tmp_path / "pendulum.py").write_text(block("README.md", "import numpy as np\nfrom physx_core"))
    run("pendulum.py")
    assert (tmp_path / "sessions/pendulum/dataset/dataset.json").exists()
    for command in block("README.md", "physx generate").replace("\\\n", " ").splitlines():
        words = shlex.split(command, comments=True)
        assert words[0] == "physx"
        run("-m", "physx_core", *words[1:])
    assert (tmp_path / "pendulum.parquet").exists()


def test_the_program_for_those_who_come_from_deepphysx(block, run, tmp_path):
    (tmp_path / "main.py").write_text(
        block("docs/migration.md", "import numpy as np\nfrom physx_core")
    )
    run("main.py")
    assert (tmp_path / "sessions/training/network").is_dir()


def test_environments_of_gymnasium(block, run, tmp_path):
    code = block("README.md", "import gymnasium")
    check = "\nenv.reset(seed=0)\nmany.reset(seed=0)\nmany.close()\n"
    (tmp_path / "robots.py").write_text(f"if __name__ == '__main__':\n{_indent(code + check)}")
    run("robots.py")


def _indent(code):
    return "".join(f"    {line}" for line in code.splitlines(keepends=True))
