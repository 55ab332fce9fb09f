"""`physx new` writes plugins that install, pass the contract kit, and work until removed."""

import ast
import re
import subprocess
import sysconfig
import venv

import pytest

pytestmark = pytest.mark.processes

pytest.importorskip("torch")
INTERNAL = ("checkpoint", "dataset", "observers", "session", "statistics", "toy")
TRAIN = (
    "train", "sessions/data_generation", "--network.loss", "MSELoss", "--network.optimizer", "Adam",
    "--epoch-nb", 2, "--batch-size", 20, "--network.network",
)  # fmt: skip


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of a virtual environment that has everything installed here."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    (found,) = folder.glob("lib/python*/site-packages")
    below = sysconfig.get_path("purelib")
    (found / "below.pth").write_text(f"import site; site.addsitedir({below!r})\n")
    return folder / "bin/python"


@pytest.fixture
def call(python, tmp_path):
    """Run a module with the interpreter; return what it printed."""

    def run(*words, ok=True):
        command = [python, "-m", *map(str, words)]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (not ended.returncode) == ok, ended.stdout + ended.stderr
        return ended.stdout + ended.stderr

    return run


@pytest.mark.parametrize(
    "kind",
    [
        "environment",
        pytest.param("visualizer", marks=pytest.mark.faults),
        pytest.param("launcher", marks=pytest.mark.faults),
        "format",
        pytest.param("plugin", marks=pytest.mark.faults),  # with an environment and a network
        pytest.param("network", marks=pytest.mark.faults),
        pytest.param("backend", marks=pytest.mark.faults),
    ],
)
def test_a_new_plugin_works_until_it_is_removed(call, tmp_path, kind):
    name = f"wave-{kind}"
    folder = tmp_path / f"physx-{name}"
    call("physx_core", "new", kind, name)
    options = ("--quiet", "--disable-pip-version-check")
    call("pip", "install", *options, "--no-deps", "--no-build-isolation", folder)
    try:
        listing = call("physx_core", "plugins")
        for each in ("environment", "network") if kind == "plugin" else (kind,):
            assert f"{each}: {name}/{name}" in listing
        assert "passed" in call("pytest", "-q", "-p", "no:cacheprovider", folder)
        (check,) = re.findall("^physx (check .*)$", (folder / "README.md").read_text(), re.M)
        assert "passed" in call("physx_core", *check.split())
        use(call, kind, name, tmp_path)
    finally:
        call("pip", "uninstall", *options, "--yes", f"physx-{name}")
    assert f'No plugin "{name}"' in call("physx_core", "check", name, ok=False)


def use(call, kind, name, folder):
    """What the README of the plugin says, at a small size."""
    source = name if kind in ("environment", "plugin") else "toy/spring"
    shown = (f"--environment.{kind}", name) if kind in ("visualizer", "launcher") else ()
    if kind == "backend":
        readme = (folder / f"physx-{name}/README.md").read_text()
        code = readme.partition('python -c "\n')[2].partition('\n"\n')[0]
        (folder / "falls.py").write_text(code)
        height = float(call("falls").split()[2])
        assert height == pytest.approx(1 - 9.81 * 0.1**2 / 2, abs=1e-3)
        return
    call("physx_core", "generate", source, "--batch-nb", 4, "--batch-size", 25, *shown)
    if kind == "visualizer":
        lines = (folder / "sessions/data_generation/data_generation.txt").read_text()
        assert "1 0 add mass" in lines
    if kind == "format":
        call("physx_core", "export", "sessions/data_generation", "file", "--to", name)
        assert "100 training samples" in call("physx_core", "import", "file", "copy")
        assert "m, m/s" in call("physx_core", "info", "copy")
    if kind in ("network", "plugin"):
        assert "training loss" in call("physx_core", *TRAIN, name)


def test_new_plugins_import_faces_only(call, tmp_path):
    for kind in ("plugin", "visualizer", "launcher", "format", "backend"):
        call("physx_core", "new", kind, f"a-{kind}", "--folder", "made")
    files = list((tmp_path / "made").rglob("*.py"))
    assert len(files) == 21
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("physx_"):
                package, *rest = (node.module or "").split(".")
                if package == "physx_core":
                    assert len(rest) < 2 and not set(rest) & set(INTERNAL), node.module


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("plugin", "torch"), 'There is already a plugin "torch"'),
        (("plugin", "core"), "is the name of physx-core"),
        (("plugin", "Wave Tank"), "lowercase letters"),
        (("plugin", "../x"), "lowercase letters"),
        (("network", "x", "--folder", "file"), "cannot be written"),
        (("plugin", "made"), "already exists"),
    ],
)
def test_mistakes_are_named(call, tmp_path, words, message):
    (tmp_path / "file").touch()
    (tmp_path / "physx-made").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert message in call("physx_core", "new", *words, ok=False)
    assert sorted(tmp_path.rglob("*")) == before
