"""Notebooks: the source of classes written in cells, for the clients of this process.

Only a child process gets it, through memory that it inherits: it is never stored, and never read
from a socket. The child imports it as the module `MODULE`.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import inspect
import linecache
import os
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

from physx_core.errors import UsageError

MODULE = "physx_cells"
"""The module in which a child process, and this one, finds them."""
_VARIABLE = "PHYSX_CELLS"
_names: dict[str, None] = {}


def in_notebook() -> bool:
    """Return whether this process runs the cells of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def has_source(component: Any) -> bool:
    """Return whether a class or function comes from a cell whose text is known."""
    return component.__module__ == "__main__" and _definition(component) is not None


def register(name: str) -> str:
    """Have the clients of this process know a class of the notebook; return its reference."""
    _names[name] = None
    sys.modules[MODULE] = sys.modules["__main__"]  # here it is what the cells define now
    return f"{MODULE}:{name}"


@contextlib.contextmanager
def lent() -> Iterator[tuple[dict[str, str], Sequence[int]]]:
    """Lend the source to a process that starts meanwhile: its variables, and file descriptors.

    Raises:
        UsageError: If a class uses what cannot be sent.
    """
    if not _names:
        yield {}, ()
        return
    number = os.memfd_create(MODULE)
    try:
        with os.fdopen(number, "w", encoding="utf-8", closefd=False) as memory:
            memory.write(_gather(list(_names)))
        yield {_VARIABLE: str(number)}, (number,)
    finally:
        os.close(number)


def take() -> None:
    """Make what the parent process has lent importable."""
    number = os.environ.pop(_VARIABLE, None)
    if number is not None:
        with os.fdopen(int(number), encoding="utf-8") as memory:
            memory.seek(0)
            sys.meta_path.append(_Finder(memory.read()))


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Finds and loads the module from its text."""

    def __init__(self, text: str) -> None:
        self._text = text

    def find_spec(
        self, fullname: str, path: Any = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != MODULE:
            return None
        lines = self._text.splitlines(keepends=True)
        linecache.cache["notebook"] = (len(self._text), None, lines, "notebook")
        return importlib.util.spec_from_loader(fullname, self)

    def get_source(self, fullname: str) -> str:
        return self._text

    def get_code(self, fullname: str) -> Any:
        return self.source_to_code(self._text, "notebook")


def _gather(names: Sequence[str]) -> str:
    """Return a module's text with some classes of the notebook, and all that they use."""
    found: dict[str, str] = {}
    for name in names:
        _add(name, name, found)
    return "from __future__ import annotations\n\n" + "\n\n".join(filter(None, found.values()))


def _add(name: str, user: str, found: dict[str, str]) -> None:
    """Add a name of the notebook after those that it uses itself."""
    if name in found:
        return
    found[name] = ""  # what uses itself is no endless loop
    text, used = _text_of(name, vars(sys.modules["__main__"])[name], user)
    for other in used:
        _add(other, name, found)
    del found[name]
    found[name] = text


def _text_of(name: str, value: Any, user: str) -> tuple[str, Sequence[str]]:
    """Return the statement that defines a name, and the names of the notebook that it uses."""
    if isinstance(value, ModuleType):
        return f"import {value.__name__} as {name}", ()
    node = _definition(value) if getattr(value, "__module__", None) == "__main__" else None
    if node is not None:
        known = vars(sys.modules["__main__"])
        used = (each.id for each in ast.walk(node) if isinstance(each, ast.Name))
        return ast.unparse(node), [each for each in used if each in known and each != name]
    place, path = getattr(value, "__module__", None), getattr(value, "__qualname__", "")
    if place not in (None, "__main__") and getattr(sys.modules.get(place), path, None) is value:
        return f"from {place} import {path} as {name}", ()
    with contextlib.suppress(ValueError, SyntaxError, TypeError):
        if ast.literal_eval(repr(value)) == value:
            return f"{name} = {value!r}", ()
    raise UsageError(
        f"{user} uses {name} of the notebook, which clients cannot get, as it is a "
        f"{type(value).__name__}: make it in create(), give it in env_kwargs as an array or plain "
        "values, or run with as_tcp_ip_client=False."
    )


def _definition(value: Any) -> ast.ClassDef | ast.FunctionDef | None:
    """Return the syntax of a class or function that a cell defines; None: its text is unknown."""
    functions = [value, *vars(value).values()] if inspect.isclass(value) else [value]
    files = [each.__code__.co_filename for each in functions if inspect.isfunction(each)]
    name = getattr(value, "__name__", "")
    cells = [file for file in linecache.cache if "ipython" in file or "ipykernel" in file]
    for file in [*files[:1], *reversed(cells)]:
        with contextlib.suppress(SyntaxError):
            for node in reversed(ast.parse("".join(linecache.getlines(file))).body):
                if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
                    return node
    return None
