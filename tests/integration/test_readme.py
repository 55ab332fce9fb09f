"""The programs and commands of README.md and of pages that no package owns run as printed."""

import re
import shlex

import pytest

from physx_core import Dataset, checkpoint

pytestmark = pytest.mark.slow

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
    for words in commands(block("README.md", "physx generate")):
        run("-m", "physx_core", *words)
    assert (tmp_path / "pendulum.parquet").exists()


@pytest.mark.parametrize(
    ("page", "field", "network"),
    [("README.md", "state", "pendulum_network"), ("docs/migration.md", "input", "training")],
)
def test_a_new_user_starts_the_program_three_times(page, field, network, block, run, tmp_path):
    """The first time with a mistake, the last time with another simulation."""
    script, sessions = tmp_path / "pendulum.py", tmp_path / "sessions"
    code = block(page, "import numpy as np\nfrom physx_core")
    code = re.sub("batch_nb=[0-9]+, batch_size=[0-9]+", "batch_nb=4, batch_size=25", code)
    code = re.sub("epoch_nb=[0-9]+", "epoch_nb=1", code)

    def learned(run_name):
        """Mean of what the network was trained on."""
        found = checkpoint.find(sessions / run_name, None, -1)
        return found.normalization[field].mean[0]

    script.write_text(code.replace(f"{field}=before", f"{field}s=before"))
    failed = run(script, ok=False).stderr
    assert f'Did you mean "{field}"?' in failed
    assert "session: sessions/pendulum is removed, as the run kept nothing in it" in failed
    assert list(sessions.iterdir()) == []

    script.write_text(code)
    said = run(script).stderr
    assert "session: sessions/pendulum\n" in said and f"session: sessions/{network}\n" in said
    assert said.count("samples: 100 training in sessions/pendulum/dataset") == 2
    assert f"checkpoint: sessions/{network}/network/network_0" in said
    assert abs(learned(network)) < 10

    script.write_text(code.replace("self.rng.uniform(", "100 + self.rng.uniform("))
    said = run(script).stderr
    assert 'session: sessions/pendulum_1 ("pendulum" exists)' in said
    assert f'session: sessions/{network}_1 ("{network}" exists)' in said
    assert said.count("samples: 100 training in sessions/pendulum_1/dataset") == 2
    assert learned(f"{network}_1") > 50


def test_environments_of_gymnasium(block, run, tmp_path):
    code = block("README.md", "import gymnasium")
    check = "\nenv.reset(seed=0)\nmany.reset(seed=0)\nmany.close()\n"
    (tmp_path / "robots.py").write_text(f"if __name__ == '__main__':\n{_indent(code + check)}")
    run("robots.py")


def test_learning_while_simulating(root, run, tmp_path):
    text = (root / "docs/online.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S)
    program = "\n".join(code for language, code in blocks if language == "python")
    (tmp_path / "spring.py").write_text(program)
    assert "1000 samples of 50 simulations" in run("spring.py").stdout
    with Dataset.open(tmp_path / "sessions/edges") as dataset:
        assert set(dataset["parameters"]["stiffness"][:]) == {10.0, 40.0}
    for words in commands("".join(code for language, code in blocks if not language)):
        run("-m", "physx_core", *words)
    assert (tmp_path / "sessions/springs/network").exists()


def commands(code):
    """Return the words after "physx" of each command of a block."""
    lines = code.replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in lines]
    assert {words[0] for words in found} == {"physx"}
    return [words[1:] for words in found]


def _indent(code):
    return "".join(f"    {line}" for line in code.splitlines(keepends=True))
