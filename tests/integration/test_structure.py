"""No module imports in a circle, not even for type checkers; what closes is a context manager."""

import ast
import graphlib
import inspect
from pathlib import Path

import public_names
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.name for path in ROOT.glob("physx_*") if (path / "src").is_dir())


def modules_of(package):
    """Return the files of a package by the names of their modules."""
    source = ROOT / package / "src"
    files = (source / package).rglob("*.py")
    names = {".".join(file.relative_to(source).with_suffix("").parts): file for file in files}
    return {name.removesuffix(".__init__"): file for name, file in names.items()}


def imported_by(file, known):
    """Return the known modules that a file imports, wherever in the file it does so."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (names & known) or {node.module}
    return found & known


@pytest.mark.parametrize("package", PACKAGES)
def test_modules_do_not_import_in_circles(package):
    modules = modules_of(package)
    assert len(modules) > 3
    graph = {name: imported_by(file, modules.keys()) for name, file in modules.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


@pytest.mark.slow  # imports all packages
def test_what_can_be_closed_is_a_context_manager():
    pytest.importorskip("torch")
    found = {
        f"{each.module}.{each.name}": hasattr(each.value, "__enter__")
        for each in public_names.described()
        if inspect.isclass(each.value) and hasattr(each.value, "close")
    }
    assert {"physx_gym.ParallelVectorEnv", "physx_remote.PhysxVectorEnv"} <= found.keys()
    assert [name for name, can_enter in found.items() if not can_enter] == []
