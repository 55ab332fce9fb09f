"""Creates the options of a command from its words."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import sys
import typing
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import tyro

from physx_core.cli.arguments import argument_registry
from physx_core.config import configuration_in

T = TypeVar("T")


def options_from(make: type[T], words: Sequence[str], verb: str) -> T:
    """Create the options of a command from its words; ``--help`` and mistakes end the process.

    Args:
        make: Dataclass of the options; its docstring, and those of its attributes, are the help.
        words: The words after the command.
        verb: The command, such as ``evaluate``.
    """
    set_help(make)
    with argument_registry():
        return tyro.cli(make, args=words, prog=f"physx {verb}")


def set_help(cls: type[Any]) -> None:
    """Pass a configuration's docstrings to tyro: its own parser would break their lines."""
    docs = docstrings(cls)
    hints = typing.get_type_hints(cls)
    for option in dataclasses.fields(cls):
        if (nested := configuration_in(hints[option.name])) is not None:
            set_help(nested)
        option.metadata = MappingProxyType({**option.metadata, "help": docs.get(option.name, "")})


def docstrings(cls: type[Any]) -> dict[str, str]:
    """Return the attribute docstrings of a class and its bases, each as one line."""
    docs: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, reversed(cls.__mro__)):
        tree = ast.parse(inspect.getsource(sys.modules[base.__module__]))
        found = (node for node in tree.body if isinstance(node, ast.ClassDef))
        body = next((node.body for node in found if node.name == base.__name__), [])
        for statement, following in itertools.pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(following, ast.Expr):
                name, text = ast.unparse(statement.target), following.value
                words = str(text.value).split() if isinstance(text, ast.Constant) else []
                docs[name] = " ".join(words)
    return docs
