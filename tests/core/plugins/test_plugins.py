import os
import re
import signal
import subprocess
import sys
import time
from importlib import metadata

import pytest

import physx_core
from physx_core import Environment, plugins
from physx_core.cli import main
from physx_core.errors import (
    ComponentNotFoundError,
    PluginError,
    PluginNotFoundError,
    ReferenceFormError,
)
from physx_core.origin import install_hint
from physx_core.plugins import commands, registry
from physx_core.plugins.references import locate

pytestmark = pytest.mark.processes


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


def test_metadata_is_read_once(monkeypatch):
    read = []
    text_of = metadata.PathDistribution.read_text
    monkeypatch.setattr(
        metadata.PathDistribution,
        "read_text",
        lambda self, name: (read.append(name), text_of(self, name))[1],
    )
    known = plugins.available(), plugins.resolve("environment", "toy/spring")
    read.clear()
    assert (plugins.available(), plugins.resolve("environment", "toy/spring")) == known
    assert read == []


def test_available_reads_metadata_only():
    code = (
        "import sys; from physx_core import plugins; a = plugins.available(); "
        "assert a['toy'].module == 'physx_core.toy', a; "
        "print([m for m in ('physx_core.toy', 'torch', 'dartpy', 'rerun') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.slow
def test_broken_plugins_are_reported_and_the_rest_works(tmp_path):
    add_plugin(tmp_path, "good", GOOD)
    add_plugin(tmp_path, "raises", "raise RuntimeError('on purpose')")
    add_plugin(tmp_path, "misspelt", GOOD.replace("physx_environments", "physx_enviroments"))
    add_plugin(tmp_path, "arguments", GOOD.replace("environments()", "environments(what)"))
    add_plugin(tmp_path, "nothing", GOOD.replace('return {"spring": Spring}', "return 5"))
    add_plugin(tmp_path, "fails", GOOD.replace('return {"spring": Spring}', "return {}[5]"))
    add_plugin(tmp_path, "empty", "")
    add_plugin(tmp_path, "unmarked", GOOD.replace("@hookimpl", ""))
    add_plugin(tmp_path, "twice", GOOD, "first-dist")
    add_plugin(tmp_path, "twice", GOOD, "second-dist")
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0, listing.stderr
    text = listing.stdout
    assert "environment: good/spring" in text
    assert "environment: toy/spring" in text
    text = " ".join(text.split())
    assert 'Plugin "raises" (raises-dist 1.0) fails to import' in text
    assert "RuntimeError: on purpose (plugin_of_raises_dist.py, line 1)" in text
    assert 'hook physx_enviroments. Did you mean "physx_environments"?' in text
    assert "(arguments-dist 1.0) has physx_environments(what): hooks take no arguments" in text
    assert '"nothing" (nothing-dist 1.0): physx_environments() returned int, not a dict' in text
    assert '"fails" (fails-dist 1.0) fails in physx_environments(): KeyError: 5 (plu' in text
    assert '"empty" (empty-dist 1.0) has no hooks: nothing in plugin_of_empty_dist is' in text
    assert "physx_environments() in plugin_of_unmarked_dist is not marked with hookimpl" in text
    assert 'The plugin name "twice" is claimed by first-dist 1.0 and second-dist 1.0' in text
    run = physx(tmp_path, "generate", "good/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 0, run.stderr
    run = physx(tmp_path, "generate", "twice/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 1 and "claimed by" in run.stderr and "Traceback" not in run.stderr


def test_what_a_broken_plugin_requires_in_another_version_is_named(tmp_path):
    add_plugin(tmp_path, "older", "from physx_core.plugins import register_network")
    needs = ["physx-core<0.1", "no-such-package>=2", "numpy", "another ; extra == 'test'", "??"]
    with (tmp_path / "older_dist-1.0.dist-info/METADATA").open("a") as metadata_file:
        metadata_file.writelines(f"Requires-Dist: {each}\n" for each in needs)
    said = [" ".join(physx(tmp_path, command).stdout.split()) for command in ("plugins", "doctor")]
    for text in said:
        assert f"older-dist requires physx-core<0.1, but {physx_core.__version__} is" in text
        assert "older-dist requires no-such-package>=2, which is not installed." in text
        assert "requires numpy" not in text and "another" not in text
    assert "cannot import name 'register_network'" in said[0]


ENDS = {
    "exits": (
        "import sys; sys.exit(3)",
        "fails to import plugin_of_exits_dist: it calls sys.exit(3)",
    ),
    "interrupts": (
        "raise KeyboardInterrupt",
        "fails to import plugin_of_interrupts_dist: Keyboard",
    ),
    "generator": ("raise GeneratorExit", "fails to import plugin_of_generator_dist: GeneratorExit"),
    "hook-exits": (
        GOOD.replace("return", "raise SystemExit #"),
        "fails in physx_environments(): it calls sys.exit",
    ),
}


def test_plugins_that_end_the_process_break_only_themselves(tmp_path):
    for name, (code, _) in ENDS.items():
        add_plugin(tmp_path, name, code)
    add_plugin(tmp_path, "zebra", GOOD)
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0, listing.stderr
    for name, (_, said) in ENDS.items():
        assert f'broken: Plugin "{name}" ({name}-dist 1.0) {said}' in listing.stdout
    assert "environment: zebra/spring" in listing.stdout
    code = 'import sys\nif __name__ != "__main__": sys.exit(3)\n'
    add_plugin(tmp_path, "leave", code, group="physx.commands")
    run = physx(tmp_path, "leave")
    assert run.returncode == 1 and "physx leave (leave-dist 1.0) fails to import" in run.stderr


def test_components_that_end_the_process_break_only_themselves(tmp_path, monkeypatch):
    add_plugin(tmp_path, "lazy", GOOD.replace("Spring}", '"ends_at_import:Spring"}'))
    (tmp_path / "ends_at_import.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        PluginError, match='"lazy" fails to import its environment "spring": it calls'
    ):
        plugins.resolve("environment", "lazy/spring")


def test_a_broken_component_is_left_out_where_all_of_a_kind_are_used(tmp_path, monkeypatch):
    code = GOOD.replace("Spring}", '"nowhere:Spring", "good": Spring}')
    add_plugin(tmp_path, "partly", code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.warns(UserWarning, match="The environment partly/spring is left out. Plugin"):
        found = plugins.resolve_all("environment")
    assert "partly/good" in found and "toy/spring" in found and "partly/spring" not in found


HANG = "import time\ntime.sleep(600)\n"
STUBBORN = HANG.replace("time.sleep(600)", "try: time.sleep(600)\nexcept BaseException: pass")


@pytest.mark.slow
def test_plugins_that_never_end_to_import_are_named_and_given_up(tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSX_IMPORT_TIMEOUT", "1.5")
    add_plugin(tmp_path, "hang", HANG)
    add_plugin(tmp_path, "spin", "while True: pass")
    add_plugin(tmp_path, "stubborn", f"{STUBBORN}{HANG}")
    add_plugin(tmp_path, "zebra", GOOD)
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0, listing.stderr
    assert "environment: zebra/spring" in listing.stdout
    for name in ("hang", "spin", "stubborn"):
        who = f'Plugin "{name}" ({name}-dist 1.0)'
        assert f"physx: {who} is still loading" in listing.stderr
        assert f"{who} fails to import plugin_of_{name}_dist: it takes longer" in listing.stdout


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_during_an_import_ends_the_command_all_the_same(tmp_path, number, status):
    add_plugin(tmp_path, "hang", f"open('begun', 'w').close()\n{HANG}")
    process = subprocess.Popen(
        [sys.executable, "-m", "physx_core", "plugins"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    with process:
        deadline = time.monotonic() + 60
        while not (tmp_path / "begun").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(number)
        out, error = process.communicate(timeout=60)
    assert process.returncode == status
    assert "Traceback" not in error and out.rstrip().endswith("(hang-dist 1.0)")


def test_a_plugin_that_crashes_the_interpreter_can_be_told(tmp_path):
    add_plugin(tmp_path, "crash", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == -signal.SIGSEGV
    assert listing.stdout.rstrip().endswith("crash  (crash-dist 1.0)")
    assert "plugin_of_crash_dist.py" in listing.stderr


GARBAGE = {
    "no-value": b"[physx]\nnonsense\n",
    "not-text": b"[physx]\n\xff\xfe = \x00\n",
}


@pytest.mark.slow
def test_garbage_in_the_metadata_of_a_package_is_told_and_breaks_nothing_else(tmp_path):
    for name, content in GARBAGE.items():
        info = tmp_path / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_bytes(content)
    (tmp_path / "empty-1.0.dist-info").mkdir()
    add_plugin(tmp_path, "zebra", GOOD)
    (tmp_path / "zebra_dist-1.0.dist-info" / "METADATA").write_bytes(b"\x1b]0;owned\x07")
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0, listing.stderr
    assert "environment: zebra/spring" in listing.stdout
    for name in GARBAGE:
        assert f"The entry points of the package {name} cannot be read: " in listing.stdout
    assert "\x1b" not in listing.stdout + listing.stderr
    run = physx(tmp_path, "generate", "zebra/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 0, run.stderr
    run = physx(tmp_path, "generate", "nonsense/spring", "--batch-nb", "1", "--batch-size", "2")
    assert run.returncode == 1 and "entry points of no-value, not-text" in run.stderr


IMPOSSIBLE = ("1", "None", "''", "'a//b'", "'/a'", "'a b'", "'a:b'", "'\\x1b[31mred'", "'-a'")


def test_a_component_with_an_impossible_name_breaks_its_plugin(tmp_path):
    for number, name in enumerate(IMPOSSIBLE):
        code = GOOD.replace('"spring"', name)
        add_plugin(tmp_path, f"strange{number}", code)
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0 and "\x1b" not in listing.stdout
    for number in range(len(IMPOSSIBLE)):
        who = f'Plugin "strange{number}" (strange{number}-dist 1.0)'
        assert f"{who}: physx_environments() names a component" in listing.stdout
    assert "environment: toy/spring" in listing.stdout


def test_a_plugin_with_an_impossible_name_is_broken_and_printed_harmlessly(tmp_path):
    add_plugin(tmp_path, "\x1b[31mred", GOOD, "red-dist")
    add_plugin(tmp_path, "a/b", GOOD, "slash-dist")
    add_plugin(tmp_path, "\x1b[2J", GOOD, "command-dist", "physx.commands")
    listing = physx(tmp_path, "plugins")
    assert listing.returncode == 0 and "\x1b" not in listing.stdout
    assert "\\x1b[31mred  (red-dist 1.0)" in listing.stdout
    assert 'Plugin "a/b" (slash-dist 1.0) cannot have this name' in listing.stdout
    assert "\x1b" not in physx(tmp_path, "--help").stdout


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
    rows = re.findall(r"^  \S.*(?:\n {3,}\S.*)*", overview, re.MULTILINE)  # long ones go on below
    lines = {row.split()[0]: " ".join(row.split()) for row in rows}
    core = ["generate", "train", "predict", "replay", "branch", "info", "stats", "verify"]
    core += ["export", "import", "export-network", "client", "include", "plugins", "new"]
    core += ["check", "doctor", "completion"]
    assert list(lines)[: len(core)] == core
    others = list(lines)[len(core) :]
    assert others == sorted(others) and {"broken", "twice", "wave", "wrong"} <= {*others}
    assert lines["wave"].endswith("wave at the user") and "broken" in lines["wrong"]
    assert "claimed by first-dist 1.0 and second-dist 1.0; uninstall or re" in lines["twice"]
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
    monkeypatch.setattr(commands, "find_entries", lambda group: {})
    assert main([name]) == 1
    assert install_hint(package) in capsys.readouterr().err


def test_unknown_plugins_say_what_is_there_and_that_they_are_none_of_physx():
    with pytest.raises(PluginNotFoundError, match='Did you mean "toy".*not one of physx') as caught:
        plugins.resolve("environment", "tooy/spring")
    assert "toy" in caught.value.installed


def test_a_missing_plugin_of_the_project_names_its_package(monkeypatch):
    monkeypatch.setattr(registry, "find_entries", lambda group: {})
    with pytest.raises(PluginNotFoundError, match="physx_dart$"):
        plugins.resolve("environment", "dart/arm")
    with pytest.raises(PluginNotFoundError, match="physx_gym$"):
        plugins.resolve("environment", "gym/env")


def test_a_plugin_alone_stands_for_its_only_component():
    assert plugins.resolve("environment", "toy") is plugins.resolve("environment", "toy/spring")
    with pytest.raises(ComponentNotFoundError, match='"physx" has several of kind launcher: name'):
        plugins.resolve("launcher", "physx")
    with pytest.raises(ComponentNotFoundError, match='"toy" has no launcher. It has: none.'):
        plugins.resolve("launcher", "toy")


def test_a_component_without_its_plugin_is_found_for_the_message():
    with pytest.raises(PluginNotFoundError) as caught:
        plugins.resolve("environment", "spring")
    said = str(caught.value)
    assert said.startswith('No plugin "spring" is installed. Did you mean "toy/spring"? Installed')
    assert said.count("Did you mean") == 1


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


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory that Python does not look for modules in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each])
    return tmp_path


def test_a_module_is_found_in_the_working_directory_when_it_is_named(here):
    (here / "rooms").mkdir()
    (here / "rooms_measures.py").write_text("SIZE = 3\n")
    (here / "rooms/tidy.py").write_text(
        "import rooms_measures\nfrom physx_core import Environment\n"
        "class Room(Environment): size = rooms_measures.SIZE\n"
    )
    with pytest.raises(ComponentNotFoundError, match="or run where the module is"):
        plugins.resolve("environment", "halls.tidy:Room")
    plugins.resolve("environment", "toy/spring")
    assert str(here) not in sys.path
    assert plugins.resolve("environment", "rooms.tidy:Room").size == 3
    assert sys.path[0] == str(here)


def test_an_import_that_fails_in_a_module_of_the_working_directory_is_its_own_error(here):
    (here / "dusty_room.py").write_text("import no_such_broom\n")
    with pytest.raises(ModuleNotFoundError, match="no_such_broom"):
        plugins.resolve("environment", "dusty_room:Room")


def test_a_folder_where_a_command_runs_has_no_plugins(here):
    """A package that was downloaded or is being unpacked there is not installed."""
    add_plugin(here, "unpacked", GOOD)
    (here / "tqdm.py").write_text("raise SystemExit('not the library')")
    found = subprocess.run(
        [sys.executable, "-P", "-m", "physx_core.cli", "plugins"],
        capture_output=True, text=True, timeout=60, cwd=here, check=True,
    )  # fmt: skip
    assert "unpacked" not in found.stdout and "toy" in found.stdout


ADAPTING = """
from physx_core.plugins import hookimpl
class Adapted:
    pass
@hookimpl
def physx_environments():
    return {"module": lambda module, **kwargs: (module, kwargs)}
"""


def test_a_plugin_adapts_what_another_library_defines(here, monkeypatch):
    place = here / "installed"
    place.mkdir()
    add_plugin(place, "adapting", ADAPTING)
    monkeypatch.syspath_prepend(place)
    for named in ("houses:Hall-v0", "lab/houses.py:Hall", "/lab/houses.py:make"):
        make = plugins.resolve("environment", f"adapting/{named}")
        assert make(size=2) == (named, {"size": 2})
    (here / "houses.py").write_text("class Hall: pass\n")
    with pytest.raises(ReferenceFormError, match='give "adapting/houses.py:Hall"'):
        plugins.resolve("environment", "houses.py:Hall")
    with pytest.raises(ComponentNotFoundError, match='give "adapting/houses:Hall-v0"'):
        plugins.resolve("environment", "houses:Hall-v0")
    with pytest.raises(ComponentNotFoundError, match='Plugin "toy" has no environment'):
        plugins.resolve("environment", "toy/houses:Hall")
    (here / "adapting").mkdir()
    (here / "adapting/own.py").write_text(
        "from physx_core import Environment\nclass Own(Environment): pass\n"
    )
    assert plugins.resolve("environment", "adapting/own.py:Own").__name__ == "Own"


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


KIND = """
from physx_core.plugins import hookimpl, kind_hook
class Material:
    pass
class Steel(Material):
    pass
@kind_hook(f"{__name__}:Material")
def physx_materials():
    pass
"""
MATERIALS = """
from physx_core.plugins import hookimpl
@hookimpl
def physx_materials():
    return {"steel": "plugin_of_kind:Steel"}
"""
KIND_TESTS = {
    "kind_names": "assert {'network', 'material'} <= set(p.kind_names())",
    "resolve": "assert p.resolve('material', 'workshop/steel').__name__ == 'Steel'",
    "complete_reference": "assert p.complete_reference('material', 'steel') == 'workshop/steel'",
    "find_kind": "assert p.find_kind('material').base == 'plugin_of_kind:Material'",
    "another class": "import pytest\n"
    "with pytest.raises(ReferenceFormError, match='not a physx material'):\n"
    "    p.resolve('material', 'physx_core.toy:Spring')",
    "no such name": "import pytest\n"
    "with pytest.raises(ComponentNotFoundError, match='Did you mean \"steel\"'):\n"
    "    p.complete_reference('material', 'stel')",
    "no such kind": "import pytest\n"
    "with pytest.raises(ReferenceFormError, match='launcher, .*material'):\n"
    "    p.resolve('metal', 'workshop/steel')",
}


@pytest.mark.parametrize("case", KIND_TESTS)
def test_a_package_adds_a_kind_of_component(tmp_path, case):
    add_plugin(tmp_path, "physx_materials", KIND, "kind", "physx.hookspecs")
    add_plugin(tmp_path, "workshop", MATERIALS)
    code = "from physx_core import plugins as p\nfrom physx_core.errors import *\n"
    done = subprocess.run(
        [sys.executable, "-c", code + KIND_TESTS[case]],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("", "has no function physx_materials marked with kind_hook"),
        ("1 / 0", "division by zero"),
    ],
)
def test_a_broken_kind_is_named_and_breaks_no_other_plugin(tmp_path, code, message):
    add_plugin(tmp_path, "physx_materials", code, "kind", "physx.hookspecs")
    add_plugin(tmp_path, "workshop", MATERIALS)
    done = physx(tmp_path, "plugins")
    assert done.returncode == 0
    assert message in " ".join(done.stdout.split()) and "environment: toy/spring" in done.stdout


def test_a_hook_of_a_package_that_is_not_installed_is_named(tmp_path):
    add_plugin(tmp_path, "workshop", MATERIALS)
    out = " ".join(physx(tmp_path, "plugins").stdout.split())
    assert "broken:" in out and "unknown hook" in out and "physx_materials" in out


def test_a_name_that_two_plugins_have_must_say_which(tmp_path):
    for name in ("one", "two"):
        add_plugin(tmp_path, name, MATERIALS)
    add_plugin(tmp_path, "physx_materials", KIND, "kind", "physx.hookspecs")
    code = "from physx_core import plugins; plugins.complete_reference('material', 'steel')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert '"steel" may be one/steel or two/steel: give one of these.' in done.stderr
