import os
import subprocess
import sys

import pytest

from physx_core import Environment, plugins
from physx_core.cli import command, main
from physx_core.errors import ComponentNotFoundError, PluginNotFoundError, ReferenceFormError
from physx_core.plugins import registry
from physx_core.plugins.references import locate


def add_plugin(folder, name, code, distribution=None, group="physx"):
    """Put an installed-looking distribution with one plugin module into a folder."""
    distribution = distribution or f"{name}-dist"
    module = f"plugin_of_{distribution.replace('-', '_')}"
    (folder / f"{module}.py").write_text(code)
    info = folder / f"{distribution.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}\n")


GOOD = """
from physx_core.plugins import hookimpl
from physx_core.toy import Spring
@hookimpl
def physx_environments():
    return {"spring": Spring}
"""


def physx(folder, *words):
    return subprocess.run(
        [sys.executable, "-m", "physx_core", *words],
        env={**os.environ, "PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        timeout=60,
        cwd=folder,
    )


def test_available_reads_metadata_only():
    code = (
        "import sys; from physx_core import plugins; a = plugins.available(); "
        "assert a['toy'].module == 'physx_core.toy', a; "
        "print([m for m in ('physx_core.toy', 'torch', 'dartpy', 'rerun') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_broken_plugins_are_reported_and_the_rest_works(tmp_path):
    add_plugin(tmp_path, "good", GOOD)
    add_plugin(tmp_path, "raises", "raise RuntimeError('on purpose')")
    add_plugin(tmp_path, "misspelt", GOOD.replace("physx_environments", "physx_enviroments"))
    add_plugin(tmp_path, "arguments", GOOD.replace("environments()", "environments(what)"))
    add_plugin(tmp_path, "nothing", GOOD.replace('return {"spring": Spring}', "return 5"))
    add_plugin(tmp_path, "twice", GOOD, "first-dist")
    add_plugin(tmp_path, "twice", GOOD, "second-dist")
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0, listing.stderr
    text = listing.stdout
    assert "environment: good/spring" in text
    assert "environment: toy/spring" in text
    assert 'Plugin "raises" (raises-dist 1.0) fails to import' in text and "on purpose" in text
    assert "physx_enviroments" in text and "physx_environments" in text
    assert 'Plugin "arguments" (arguments-dist 1.0) has an unknown hook' in text
    assert "physx_environments() returned int, not a dictionary" in text
    assert 'The plugin name "twice" is claimed by first-dist 1.0 and second-dist 1.0' in text
    run = physx(tmp_path, "generate", "good/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 0, run.stderr
    run = physx(tmp_path, "generate", "twice/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 1 and "claimed by" in run.stderr and "Traceback" not in run.stderr


def test_commands_of_other_packages(tmp_path):
    code = '"""``physx wave``: wave at the user."""\ndef run(words):\n    print("hello", *words)\n'
    for name, text, distribution in (
        ("wave", code, None),
        ("broken", "import nowhere", None),
        ("wrong", "run = 5", None),
        ("twice", code, "first-dist"),
        ("twice", code, "second-dist"),
        ("info", code, "third-dist"),
    ):
        add_plugin(tmp_path, name, text, distribution, "physx.commands")
    (tmp_path / "plugin_of_wrong_dist.py").unlink()
    overview = physx(tmp_path, "--help").stdout
    lines = {line.split()[0]: line for line in overview.splitlines() if line.startswith("  ")}
    core = ["generate", "train", "predict", "replay", "info", "stats", "verify"]
    core += ["export", "import", "export-network", "client", "plugins"]
    assert list(lines)[: len(core)] == core
    others = list(lines)[len(core) :]
    assert others == sorted(others) and {"broken", "twice", "wave", "wrong"} <= {*others}
    assert lines["wave"].endswith("wave at the user") and "broken" in lines["wrong"]
    assert "claimed by first-dist 1.0 and second-dist 1.0; uninstall one" in lines["twice"]
    assert physx(tmp_path, "wave", "you").stdout == "hello you\n"
    for name, message in {
        "broken": "physx broken (broken-dist 1.0) fails to import plugin_of_broken_dist: No module",
        "wrong": "fails to import",
        "twice": 'The command name "twice" is claimed by first-dist 1.0 and second-dist 1.0',
        "info": 'The command name "info" is claimed by physx-core',
    }.items():
        run = physx(tmp_path, name)
        assert run.returncode == 1 and message in run.stderr and "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("name", "package"),
    [("serve", "physx-remote"), ("log", "physx-gym"), ("robots", "physx-dart")],
)
def test_a_command_of_a_missing_package_names_it(name, package, monkeypatch, capsys):
    monkeypatch.setattr(command, "find_entries", lambda group: {})
    assert main([name]) == 1
    assert f"pip install {package}" in capsys.readouterr().err


def test_unknown_plugins_say_what_is_there_and_the_pip_line():
    with pytest.raises(PluginNotFoundError, match='Did you mean "toy".*pip install') as caught:
        plugins.resolve("environment", "tooy/spring")
    assert "toy" in caught.value.installed


def test_a_missing_plugin_of_the_project_names_its_package(monkeypatch):
    monkeypatch.setattr(registry, "find_entries", lambda group: {})
    with pytest.raises(PluginNotFoundError, match="pip install physx-dart"):
        plugins.resolve("environment", "dart/arm")
    with pytest.raises(PluginNotFoundError, match="pip install physx-gym"):
        plugins.resolve("environment", "gym/env")


@pytest.mark.parametrize(
    ("reference", "error"),
    [
        ("toy/sprin", ComponentNotFoundError),
        ("no.such.module:Class", ComponentNotFoundError),
        ("physx_core.toy:Sprin", ComponentNotFoundError),
        ("nowhere.py:Class", ComponentNotFoundError),
        ("", ReferenceFormError),
        (5, ReferenceFormError),
    ],
)
def test_references_that_lead_nowhere(reference, error):
    with pytest.raises(error):
        plugins.resolve("environment", reference)


def test_all_forms_of_a_reference(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("from physx_core import Environment\nclass Mine(Environment): pass\n")
    spring = plugins.resolve("environment", "toy")
    assert plugins.resolve("environment", "toy/spring") is spring
    assert plugins.resolve("environment", "physx_core.toy:Spring") is spring
    assert plugins.resolve("environment", spring) is spring
    mine = plugins.resolve("environment", f"{script}:Mine")
    assert issubclass(mine, Environment)
    assert plugins.reference_of(mine) == f"{script}:Mine"
    assert plugins.reference_of(spring) == "physx_core.toy:Spring"
    assert plugins.reference_of("toy/spring") == "toy/spring"


def test_classes_that_no_process_can_find_are_rejected():
    class Local(Environment):
        pass

    with pytest.raises(Exception, match="inside a function"):
        plugins.reference_of(Local)


def test_components_are_named_so_that_a_client_needs_no_metadata():
    assert locate("environment", "toy/spring") == "physx_core.toy:Spring"
    assert locate("environment", "toy") == "physx_core.toy:Spring"
    assert locate("environment", "physx_core.toy:Spring") == "physx_core.toy:Spring"
    for unknown in ("toy/nothing", "nothing/spring", "nothing"):  # the client says what is wrong
        assert locate("environment", unknown) == unknown


def test_of_many_components_the_nearest_are_named():
    known = [f"Cart-v{number}" for number in range(50)] + ["Acrobot"]
    text = str(ComponentNotFoundError("environment", "Acrobat", 'Plugin "gym"', known))
    assert 'Did you mean "Acrobot"?' in text and "and 43 others (physx plugins)" in text
