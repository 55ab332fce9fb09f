"""The public names of all packages, for the reference, and whether each is documented."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from sphinx.pycode import ModuleAnalyzer

from physx_core.errors import PhysxError

# The faces, in the reference's order: a name is described in the first face that offers it.
FACES = {
    "physx_core": (
        "",
        *(
            "components",
            "config",
            "dataset",
            "pipelines",
            "plugins",
            "rotations",
            "geometry",
        ),
        *("errors", "fields", "typing", "checks", "parsing", "rows", "sources"),
        *("workers", "net", "clock", "processes", "files", "origin", "cli"),
        *("statistics", "observers"),
    ),
    "physx_sim": ("", "engines", "conformance", "errors"),
    "physx_testing": ("",),
    "physx_formats": ("", "errors"),
    "physx_dart": ("",),
    "physx_mujoco": ("",),
    "physx_torch": ("",),
    "physx_rerun": ("",),
    "physx_viser": ("",),
    "physx_gym": (
        "",
        *("blocks", "tasks.quantities", "tasks.rewards", "tasks.terminations"),
        *("tasks.randomizations", "stable_baselines3", "errors"),
    ),
    "physx_remote": ("", "errors"),
    "physx_cluster": ("", "sweep", "errors"),
    "physx_report": ("", "drawing", "errors"),
    "physx_agree": ("",),
    "physx_identify": ("", "errors"),
}
MODULES = [f"{root}.{name}".rstrip(".") for root, names in FACES.items() for name in names]


@dataclass(frozen=True)
class Name:
    """A public name.

    Attributes:
        module: The face that offers it.
        name: The name.
        value: The object itself.
        home: The module that defines it.
    """

    module: str
    name: str
    value: Any
    home: str

    @property
    def kind(self) -> str:
        """The autodoc directive that describes it."""
        if inspect.isclass(self.value):
            return "exception" if issubclass(self.value, BaseException) else "class"
        if isinstance(self.value, FunctionType):
            return "function"
        return "module" if isinstance(self.value, ModuleType) else "data"

    @property
    def text(self) -> str:
        """The text below the definition of a constant or a type."""
        found: dict[tuple[str, str], list[str]] = ModuleAnalyzer.for_module(
            self.home
        ).find_attr_docs()
        return "\n".join(found.get(("", self.name), []))


@cache
def names_of(module: str) -> tuple[Name, ...]:
    """Return the names that a face offers."""
    face = importlib.import_module(module)
    listed = getattr(face, "__all__", None)
    if listed is None:
        listed = [
            name
            for name, value in vars(face).items()
            if not name.startswith("_") and getattr(value, "__module__", None) == module
        ]
    return tuple(
        Name(module, name, value, home(module, name, value))
        for name in listed
        if not name.startswith("_") and not isinstance(value := getattr(face, name), ModuleType)
    )


def home(module: str, name: str, value: Any) -> str:
    """Return the name of the module that defines an object offered by a face."""
    if inspect.isclass(value) or isinstance(value, FunctionType):
        return str(value.__module__)
    face = importlib.import_module(module)
    path = Path(str(face.__file__))
    for source in (path.with_suffix(".pyi"), path):
        if not source.is_file():
            continue
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and name in {
                each.asname or each.name for each in node.names
            }:
                inner = f"{module}.{node.module}" if node.level else str(node.module)
                return home(inner, name, value)
    return module


def described() -> Iterator[Name]:
    """Return all public names, each from the first face that offers it, where it is described."""
    seen: set[tuple[str, str]] = set()
    for module in MODULES:
        for each in names_of(module):
            if (key := (each.home, each.name)) not in seen:
                seen.add(key)
                yield each


def reference(module: str) -> str:
    """Return the description of a face as reStructuredText with autodoc directives."""
    here = [each for each in described() if each.module == module]
    others = sorted({each.name for each in names_of(module)} - {each.name for each in here})
    lines = [f".. automodule:: {module}", "   :no-members:", ""]
    for each in here:
        if each.kind == "data":
            lines += [f".. py:data:: {module}.{each.name}", ""]
            lines += [f"   {escaped(line)}" for line in each.text.splitlines()] + [""]
            continue
        lines += [f".. auto{each.kind}:: {module}.{each.name}"]
        if each.kind != "function":
            lines += ["   :members:", *inherited(each.value), "   :show-inheritance:"]
        lines += [""]
    if others:
        lines += ["Described above: " + ", ".join(f"``{name}``" for name in others) + ".", ""]
    return "\n".join(lines)


def inherited(kind: type) -> list[str]:
    """Return the option that also describes what a class has from bases that no face offers."""
    public = {each.value for each in described() if inspect.isclass(each.value)}
    own = [base for base in kind.__mro__[1:] if base.__module__.startswith("physx")]
    if public.issuperset(own):
        return []
    others = [base.__name__ for base in kind.__mro__[1:] if base in public or base not in own]
    return [f"   :inherited-members: {', '.join(others)}"]


def escaped(line: str) -> str:
    """Escape a docstring's line so that (samples, *shape) and np.bool_ appear literally."""
    if line.startswith(":vartype"):
        return line.replace("_]", r"\_]")
    return re.sub(r"(?<![*`\w])\*(?=\w)(?![^*]*[\w.]\*(?!\w))", r"\*", line)


def undocumented() -> list[str]:
    """Return everything without text: modules, names, methods, properties, dataclass fields."""
    missing = [name for name in MODULES if not inspect.getdoc(importlib.import_module(name))]
    for each in described():
        name = f"{each.home}.{each.name}"
        if each.kind == "data":
            missing += [] if each.text else [name]
        elif not (each.value.__doc__ or "").replace(f"{each.name}(", "", 1).strip():
            missing.append(name)
        elif inspect.isclass(each.value):
            missing += [f"{name}.{member}" for member in _silent_members(each.value, each.home)]
    return missing


def _silent_members(kind: type, module: str) -> Iterator[str]:
    for name, value in vars(kind).items():
        if name.startswith("_"):
            continue
        function = getattr(value, "__func__", value)
        if isinstance(function, FunctionType | property) and not inspect.getdoc(
            getattr(kind, name)
        ):
            yield name
    if dataclasses.is_dataclass(kind):
        below = ModuleAnalyzer.for_module(module).find_attr_docs()
        text = "\n".join(base.__doc__ or "" for base in kind.__mro__)
        own = vars(kind).get("__annotations__", {})
        for name in [each.name for each in dataclasses.fields(kind) if each.name in own]:
            told = (kind.__qualname__, name) in below
            if not (told or name.startswith("_") or re.search(rf"^\s+{name}:", text, re.MULTILINE)):
                yield name


def unnamed_errors() -> list[str]:
    """Return each error that a function or method itself raises but its docstring does not name.

    To name a base class is enough. The docstring of a class counts for its special methods.
    """
    return [
        f"{name}: {error.__name__}"
        for each in described()
        for name, node, text in _functions(each)
        for error in _raised(node, each.home)
        if set(re.findall(r"\w+Error", text)).isdisjoint(base.__name__ for base in error.__mro__)
    ]


def _functions(each: Name) -> Iterator[tuple[str, ast.AST, str]]:
    """Yield the name, source and text of a function, or of the methods that a class defines."""
    tree = _definitions(each.home).get(each.name)
    name, text = f"{each.home}.{each.name}", inspect.getdoc(each.value) or ""
    if each.kind == "function" and tree is not None:
        yield name, tree, text
    elif isinstance(tree, ast.ClassDef):
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and not re.match("_(?!_)", node.name):
                own = inspect.getdoc(getattr(each.value, node.name)) or ""
                told = own + text if node.name.startswith("__") else own
                yield f"{name}.{node.name}", node, told


@cache
def _definitions(module: str) -> dict[str, ast.AST]:
    """Return the functions and classes of a module by name."""
    tree = ast.parse(inspect.getsource(importlib.import_module(module)))
    return {node.name: node for node in tree.body if hasattr(node, "name")}


def _raised(function: ast.AST, module: str) -> set[type[PhysxError]]:
    """Return the errors that a function of a module creates and raises."""
    names = vars(importlib.import_module(module))
    found = (each.exc for each in ast.walk(function) if isinstance(each, ast.Raise))
    kinds = (names.get(ast.unparse(each.func)) for each in found if isinstance(each, ast.Call))
    return {kind for kind in kinds if inspect.isclass(kind) and issubclass(kind, PhysxError)}
