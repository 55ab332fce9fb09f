"""Every example runs at a small size, is short, draws its picture, and is in the gallery."""

import ast
import importlib.util
import os
import re
import shlex

import gallery
import numpy as np
import pytest
from PIL import Image, ImageSequence

pytestmark = [pytest.mark.slow, pytest.mark.processes]

EXAMPLES = gallery.EXAMPLES
SCRIPTS = sorted(EXAMPLES.glob("[0-9][0-9]_*.py"))
QUICK = ("01", "02", "03", "04", "15", "17", "18")
"""Examples that always run; the others run with the campaigns."""
SHARED = {path.stem for path in EXAMPLES.rglob("*.py")}
PRINTED = {  # what an example has to print, as patterns
    "01_generate": (
        r"input +200 x \(10, 3\) m",
        r"1 client: .*samples/s\n4 clients: .*samples/s",
        r"first rows: \[1 2 3 4 1 2 3 4\]",
    ),
    "02_train": ("one go: True", r"linear map +\d", r"network +\d"),
    "03_predict": (r"after   0 .* [01]\.[1-9]\d* m", r"after 200 .* 0\.00\d+ m", "20 new clouds"),
    "04_own_network": (r"linear map +\d", r"FC, \d+ parameters +\d", r"deep set, 12867 parameters"),
    "10_quadruped": (r"standing on dart +0\.\d\d m", r"trotting on pinocchio +[2-9]\.\d\d m"),
    "11_pushing": (r"nothing +0 +0", r"rule +4 +4"),
    "12_reinforcement_learning": (r"chance +\d", r"rule +4\d\d", r"PPO, seed 2 +\d"),
    "15_own_loop": (r"theory_of_small_swings +\d", r"FC, width 64 +\d"),
    "16_deploy_onnx": ("loaded of physx and PyTorch: None", r"100 guesses: [\d.e-]+ m"),
    "17_two_machines": ("physx client --connect", r"instances \[1 2\], as in one process: True"),
    "20_policy_on_a_cluster": ("equal to those learned here: True",),
    "21_sorting_line": (r"without suction +1 +1 +1", r"with suction +2 +2 +2"),
    "22_mechanisms": (r"theory, mrad +0\.\d\d", r"not coupled +0\.", r"box lifted, mm +1[89]"),
    "23_lidar": (r"straight ahead +0 +0 +0", r"with lidar +1 +1 +1"),
    "24_identified_arm": (r"mass upper +kg +1 +1\.[01]\d", r"file alone +\d", r"identified +\d+%"),
}
SMALL_FILMS = ("10_quadruped", "11_pushing")
"""Examples whose film is the same at any size, so that it can be compared with the one kept."""


def skip_without_libraries(path):
    """Skip the test if an example imports what is not installed; `make test` installs it all."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
            shared = EXAMPLES / f"{node.module.replace('.', '/')}.py"
            if shared.is_file() and shared != path:
                skip_without_libraries(shared)
    for name in sorted(names - SHARED - {"environments", "networks"}):
        if importlib.util.find_spec(name) is None:
            assert not os.environ.get("CI"), f"{name} is missing: make test installs it"
            pytest.skip(f"the example needs {name}")


def assert_not_blank(path):
    """Assert that a picture, or each of a film's, shows something; and that a film moves."""
    with Image.open(path) as image:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(image)]
    for frame in frames[:: len(frames) // 4 + 1]:
        counts = [count for count, _ in frame.getcolors(frame.width * frame.height)]
        assert len(counts) > 16 and max(counts) < 0.98 * sum(counts)
    if path.suffix == ".webp":
        assert len(frames) > 1 and frames[0].tobytes() != frames[-1].tobytes()


def assert_same_film(path, kept):
    """Assert that two films show the same, but for what a driver draws otherwise."""
    films = []
    for each in (path, kept):
        with Image.open(each) as image:
            frames = [frame.convert("L") for frame in ImageSequence.Iterator(image)]
        films.append(np.array([frame.resize((40, 30)) for frame in frames], float))
    assert films[0].shape == films[1].shape
    assert np.abs(films[0] - films[1]).mean(axis=(1, 2)).max() < 5


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path, id=path.stem, marks=() if path.stem.startswith(QUICK) else pytest.mark.faults
        )
        for path in SCRIPTS
    ],
)
def test_an_example_runs_and_draws_its_picture(path, run, tmp_path):
    skip_without_libraries(path)
    picture = tmp_path / gallery.picture(path.stem).name
    done = run(path, "--small", "--picture", picture)
    if done.returncode and "Vulkan" in done.stderr and os.environ.get("CI") != "true":
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr
    for pattern in PRINTED.get(path.stem, (".",)):
        assert re.search(pattern, done.stdout), (pattern, done.stdout)
    kept = (gallery.PAGE.kept / f"{path.stem}.txt").read_text()
    assert ("Too small to judge" in done.stdout) == ("best rival" in kept)
    assert "best rival" not in done.stdout
    assert_not_blank(picture)
    if path.stem in SMALL_FILMS:
        assert_same_film(picture, gallery.picture(path.stem))
    for line in gallery.commands(path.stem).splitlines():  # what to do with what it left
        if line.startswith("physx ") and not line.startswith("physx view"):
            then = run("-m", "physx_core", *shlex.split(line, comments=True)[1:])
            assert then.returncode == 0, (line, then.stdout + then.stderr)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_an_example_is_short_and_tells_what_it_is(path):
    lines = path.read_text().splitlines()
    assert len(lines) < 80
    title, _, told = gallery.beginning(path.stem).partition("\n\n")
    assert "\n" not in title and f"python examples/{path.name}" in told


def test_the_gallery_is_what_the_examples_say():
    pages = gallery.PAGE.texts()
    for path, text in pages.items():
        assert path.read_text() == text, "python docs/gallery.py writes it"
    assert set(gallery.PAGES.glob("*.md")) == pages.keys() - {gallery.PAGE.path}


def test_each_script_is_a_notebook():
    nbformat = pytest.importorskip("nbformat")
    for path in SCRIPTS:
        made = nbformat.reads(gallery.notebook(path.stem), 4)
        nbformat.validate(made)
        first, *cells = made.cells
        assert first.source.startswith(f"# {gallery.title_of(path.stem)}\n")
        [*same, last] = [ast.unparse(each) for c in cells[1:] for each in ast.parse(c.source).body]
        [*script, end] = map(ast.unparse, ast.parse(path.read_text()).body[1:])
        assert same == script and last.split("\n")[-1].strip() in end and "xit(" not in last


def test_the_gallery_has_everything_there_is():
    there = {path.stem for path in EXAMPLES.iterdir() if not path.name.startswith((".", "_"))}
    shared = {"common", "ppo", "environments", "networks", "requirements"}
    assert there - shared == set(gallery.names())


@pytest.mark.parametrize("name", [name for name in gallery.names() if name[0].isdigit()])
def test_a_full_run_of_each_example_is_kept_with_its_picture(name):
    assert (gallery.PAGE.kept / f"{name}.txt").is_file(), f"python docs/gallery.py {name}"
    assert gallery.picture(name).is_file(), f"python docs/gallery.py {name}"


def test_each_picture_and_each_run_that_is_kept_belongs_to_an_example():
    kept = {path for path in gallery.PAGE.kept.iterdir() if path.suffix != ".txt"}
    assert kept <= {gallery.picture(name) for name in gallery.names()}
    assert {path.stem for path in gallery.PAGE.kept.glob("*.txt")} <= set(gallery.names())
    for path in kept:
        assert path.stat().st_size < (600_000 if path.suffix == ".webp" else 150_000)
        assert_not_blank(path)
    for path in gallery.PAGE.kept.glob("*.txt"):
        assert "exit status 0" in path.read_text().partition("\n")[0]


def test_what_examples_import_is_in_their_requirements():
    text = (EXAMPLES / "requirements.txt").read_text().lower()
    wanted = {"felupe", "scipy", "neuralop", "torch_geometric", "stable_baselines3", "onnxruntime"}
    distributions = {"neuralop": "neuraloperator"}
    for path in EXAMPLES.rglob("*.py"):
        for name in wanted & set(re.findall(r"(?:import|from) (\w+)", path.read_text())):
            assert distributions.get(name, name).replace("_", "-") in text, (path, name)


def test_a_shared_module_is_found_by_clients(run, tmp_path):
    """The folder of a script is where clients look for its modules, too."""
    (tmp_path / "environments").mkdir()
    (tmp_path / "environments/own.py").write_text(
        "import physx_core.toy\n\nclass Own(physx_core.toy.Spring):\n    pass\n"
    )
    (tmp_path / "script.py").write_text(
        "from environments.own import Own\n"
        "from physx_core import DataGeneration, EnvironmentConfig\n"
        'if __name__ == "__main__":\n'
        "    config = EnvironmentConfig(Own, num_clients=2)\n"
        "    DataGeneration(config, batch_nb=1, batch_size=4).execute()\n"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run(tmp_path / "script.py", cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    assert list(elsewhere.glob("sessions/*/dataset"))
