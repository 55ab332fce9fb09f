"""Clients in another interpreter, with the packages of that one."""

from __future__ import annotations

import ast
import sys
import venv
from pathlib import Path

import numpy  # noqa: F401 - linked
import pytest

import physx_core
from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.cli import main
from physx_core.errors import ConfigError

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAMS = Path(__file__).parents[1] / "programs"
ELSEWHERE = f"{PROGRAMS / 'elsewhere_envs.py'}:Elsewhere"


@pytest.fixture
def make_python(tmp_path):
    """Return a function that makes an interpreter with nothing but some packages."""

    def make(*packages):
        folder = tmp_path / "".join(["python", *packages])
        venv.create(folder)
        (site,) = folder.glob("lib/python*/site-packages")
        for each in (found for name in packages for found in package_folders(name)):
            (site / each.name).symlink_to(each)
        return folder

    return make


def package_folders(name):
    folder = Path(sys.modules[name].__file__).parent
    return [each for each in (folder, folder.with_name(f"{name}.libs")) if each.exists()]


def generate(name, **options):
    config = EnvironmentConfig(ELSEWHERE, seed=3, num_clients=2, **options)
    DataGeneration(config, episodes=8, session_name=name, quiet=True).execute()
    with Dataset.open(f"sessions/{name}") as dataset:
        return {field: values[:].tobytes() for field, values in dataset["training"].items()}


def test_clients_run_in_another_interpreter_without_physx(make_python):
    folder = make_python("numpy")
    kwargs = {"python": str(folder / "bin/python"), "env": {"SETTING": "yes"}}
    rows = generate("there", launcher_kwargs=kwargs)
    said = [ast.literal_eval(Path(f"{number}.txt").read_text()) for number in (1, 2)]
    for each in said:
        assert each["prefix"] == str(folder)
        assert each["setting"] == "yes"
        assert each["packages"] == []
        assert Path(each["real"]).samefile(physx_core.__file__)
        assert not Path(each["physx"]).exists()  # it was lent
        assert Path(each["numpy"]).is_relative_to(folder)
    assert rows == generate("here", as_tcp_ip_client=False)


def test_clients_in_another_interpreter_use_the_physx_that_is_installed_there(make_python):
    folder = make_python("numpy", "physx_core", "lazy_loader", "pluggy")
    generate("there", launcher_kwargs={"python": str(folder / "bin/python")})
    said = ast.literal_eval(Path("1.txt").read_text())
    assert Path(said["physx"]).is_relative_to(folder)


def test_environment_variables_of_clients_replace_those_of_the_run(monkeypatch):
    monkeypatch.setenv("SETTING", "no")
    words = [
        "--episodes",
        "2",
        "--environment.launcher-kwargs",
        f"python={sys.executable}",
        'env={SETTING="yes"}',
    ]
    assert main(["generate", ELSEWHERE, *words]) == 0
    assert ast.literal_eval(Path("1.txt").read_text())["setting"] == "yes"


@pytest.fixture
def script(tmp_path):
    """Return a function that makes a program that prints something."""

    def make(text):
        path = tmp_path / "python"
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
        return str(path)

    return make


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("echo '[[3, 9], [\"numpy\"]]'", r"is Python 3\.9, but clients need 3\.11.*external"),
        ("echo no such module >&2; exit 1", "does not run as a Python interpreter: no such module"),
        ("exit 1", "does not run as a Python interpreter: .*exit status 1"),
        ("echo hello", "does not run as a Python interpreter"),
    ],
)
def test_an_interpreter_that_cannot_run_clients_is_named(clients, script, text, error):
    python = script(text)
    with (
        pytest.raises(ConfigError, match=f"{python} {error}"),
        clients(launcher_kwargs={"python": python}),
    ):
        pass


def test_an_interpreter_without_numpy_is_told_how_to_get_it(clients, make_python):
    python = str(make_python() / "bin/python")
    error = f"{python} has no NumPy, which clients need:  {python} -m pip install numpy"
    with pytest.raises(ConfigError, match=error), clients(launcher_kwargs={"python": python}):
        pass


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (
            {"python": "/none/python"},
            "/none/python does not run as .*No such",
        ),
        ({"python": 3}, "python must be the path of an interpreter"),
        (
            {"env": {"OMP_NUM_THREADS": 4}},
            "env must be a table .*values are strings",
        ),
        ({"env": ["A=1"]}, "env must be a table"),
        ({"env": {"A=B": "1"}}, "env must be a table"),
        ({"env": {"PHYSX_TOKEN": "1"}}, "env must not set PHYSX_TOKEN"),
    ],
)
def test_options_that_no_client_can_be_started_with(clients, options, error):
    with pytest.raises(ConfigError, match=error), clients(launcher_kwargs=options):
        pass
