"""The kinds of objects that states know."""

from __future__ import annotations

import enum
import functools
import re
from collections import OrderedDict, deque
from collections.abc import Iterator
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from physx_core.errors import StateError
from physx_core.states.arrays import ARRAYS
from physx_core.states.classes import cached_of, class_named, class_of, new_of, recipe_of, slots_of
from physx_core.states.kind import Kind, Part, RefusedError, StateAdapter, Value

_BITS = {
    kind.__name__: kind
    for kind in (
        *(np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM),
        *(np.random.Philox, np.random.SFC64),
    )
}
_BASES = {each.__name__: each for each in (dict, list, tuple, set, frozenset, deque, object)}


class _Unknown(Kind):
    def read(self, value: Any, part: Part) -> Any:
        raise RefusedError("cannot be captured")


class _Snapshot(Kind):
    def read(self, value: Any, part: Part) -> Any:
        return part(value.snapshot(), ".snapshot()")

    def settle(self, node: Any, content: Any, value: Value) -> None:
        if content is not None:
            node.restore(value(content))


class _Adapted(Kind):
    """An object of a class that a package has an adapter for."""

    def __init__(self, adapter: StateAdapter) -> None:
        self._adapter = adapter

    def read(self, value: Any, part: Part) -> Any:
        return {name: part(each, f".{name}") for name, each in self._adapter.parts(value).items()}

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        plain = {name: part for name, part in content.items() if type(part) is not tuple}
        self._adapter.assign(node, plain)

    def settle(self, node: Any, content: Any, value: Value) -> None:
        self._adapter.settle(node)


class _Object(Kind):
    """An object of a Python class, with attributes."""

    def read(self, value: Any, part: Part) -> Any:
        return read_attributes(value, part)

    def recipe(self, value: Any) -> Any:
        return recipe_of(class_of(value), object)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return new_of(recipe, object)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        values = {name: value(part) for name, part in content.items()}
        own = getattr(node, "__dict__", {})
        for name in own.keys() - values.keys() - kept:
            del own[name]
        for name in slots_of(class_of(node)):
            if name in values:
                object.__setattr__(node, name, values.pop(name))
            elif hasattr(node, name):
                object.__delattr__(node, name)
        own.update(values)


class _Items(Kind):
    """A list, deque or set, or a tuple or frozenset, which cannot be filled."""

    def __init__(self, base: Any) -> None:
        self._base, self.hashes = base, base is set
        self._is_fixed = base in (tuple, frozenset)

    def read(self, value: Any, part: Part) -> Any:
        _check_bare(value)
        if self._base in (set, frozenset):  # whose order may differ between processes
            value = sorted(value, key=repr)
        return [part(each, f"[{place}]") for place, each in enumerate(value)]

    def recipe(self, value: Any) -> Any:
        if self._base is deque:
            return value.maxlen
        return recipe_of(class_of(value), self._base)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        if self._base is deque:
            return deque(maxlen=recipe)
        items = [[value(part) for part in content]] if self._is_fixed else []
        return new_of(recipe, self._base, *items)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        if not self._is_fixed:
            base: Any = self._base  # a class may have methods of its own
            base.clear(node)
            (base.update if base is set else base.extend)(node, [value(part) for part in content])


class _Dict(Kind):
    hashes = True

    def read(self, value: Any, part: Part) -> Any:
        _check_bare(value)
        return [
            found
            for key, each in value.items()
            for found in (part(key, " key"), part(each, f"[{key!r:.40}]"))
        ]

    def recipe(self, value: Any) -> Any:
        return recipe_of(class_of(value), dict)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return new_of(recipe, dict)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        parts = [value(part) for part in content]
        base: Any = OrderedDict if isinstance(node, OrderedDict) else dict
        base.clear(node)  # a class may have methods of its own
        for key, each in zip(parts[::2], parts[1::2], strict=True):
            base.__setitem__(node, key, each)


class _Bits(Kind):
    """What a random generator draws its bits from."""

    def read(self, value: Any, part: Part) -> Any:
        return [as_lists(value.state), getattr(value.seed_seq, "n_children_spawned", 0)]

    def recipe(self, value: Any) -> Any:
        seeds = value.seed_seq
        return [type(value).__name__, None if seeds is None else seeds.state]

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        name, seeds = recipe
        return _BITS[name](None if seeds is None else np.random.SeedSequence(**seeds))

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        node.state, spawned = content
        missing = spawned - getattr(node.seed_seq, "n_children_spawned", 0)
        if missing < 0:
            raise StateError("A random generator has spawned others since: restore a new object.")
        if missing:
            node.seed_seq.spawn(missing)


class _Generator(Kind):
    def read(self, value: Any, part: Part) -> Any:
        return [part(value.bit_generator, ".bit_generator")]

    def recipe(self, value: Any) -> Any:
        return None

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return np.random.Generator(value(content[0]))


class _Enum(Kind):
    def read(self, value: Any, part: Part) -> Any:
        return part(value.value, ".value")

    def recipe(self, value: Any) -> Any:
        return recipe_of(class_of(value), enum.Enum)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return class_named(recipe, enum.Enum)(value(content))


class _Function(Kind):
    """A function, whose closure may change; or one with arguments."""

    def read(self, value: Any, part: Part) -> Any:
        if isinstance(value, functools.partial):
            names = ("func", "args", "keywords")
            return {name: part(getattr(value, name), f".{name}") for name in names}
        if isinstance(value, FunctionType):
            return {name: part(cell.cell_contents, f".{name}") for name, cell in _cells(value)}
        is_free = isinstance(value.__self__, ModuleType)
        return {} if is_free else {"__self__": part(value.__self__, ".__self__")}

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        if isinstance(node, FunctionType):
            for name, cell in _cells(node):
                cell.cell_contents = value(content[name])


class _Method(_Function):
    """A method of an object that is part of the graph."""

    def recipe(self, value: Any) -> Any:
        name = value.__name__
        if getattr(type(value.__self__), name, None) is not value.__func__:
            raise RefusedError("is not a method of its class")
        return name

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        owner = value(content["__self__"])
        function = getattr(type(owner), recipe)
        if not isinstance(function, FunctionType):
            raise StateError(f"{type(owner).__name__} has no method {recipe}().")
        return MethodType(function, owner)


KINDS: dict[str, Kind] = {
    **{base.__name__: _Items(base) for base in (list, tuple, set, frozenset, deque)},
    "dict": _Dict(),
    "object": _Object(),
    **ARRAYS,
    "bits": _Bits(),
    "generator": _Generator(),
    "enum": _Enum(),
    "function": _Function(),
    "method": _Method(),
    "snapshot": _Snapshot(),
    "fixed": Kind(),
    "unknown": _Unknown(),
}
_OF_TYPES: tuple[tuple[Any, str], ...] = (
    (enum.Enum, "enum"),
    (MethodType, "method"),
    ((FunctionType, BuiltinFunctionType, functools.partial), "function"),
    (np.dtype, "dtype"),
    ((type, ModuleType, np.ufunc, range, slice, re.Pattern), "fixed"),
)


def kind_of(value: Any) -> str:
    """Return the name of the kind of an object."""
    kind: Any = type(value)
    if kind is np.ndarray:
        return "view" if value.size and type(value.base) is np.ndarray else "array"
    return _kind_of_class(kind)


@functools.cache
def _kind_of_class(kind: Any) -> str:
    """Return the kind of a class's objects; "unknown" if they have memory of their own in C."""
    if kind is np.random.Generator or kind in _BITS.values():
        return "generator" if kind is np.random.Generator else "bits"
    for types, name in _OF_TYPES:
        if issubclass(kind, types):
            return name
    if all(callable(getattr(kind, name, None)) for name in ("snapshot", "restore")):
        return "snapshot"
    base = next(each for each in _BASES.values() if issubclass(kind, each))
    slots = 0 if kind is base else len(slots_of(kind))
    words = slots + (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
    is_known = kind.__basicsize__ <= base.__basicsize__ + 8 * words
    is_known &= kind is not object and (base is not deque or kind is deque)
    if kind is OrderedDict or (is_known and (base is object or not slots)):
        return base.__name__
    return _adapted(f"{kind.__module__}.{kind.__qualname__}") or "unknown"


def _adapted(name: str) -> str | None:
    """Return the kind of a class that an installed package has an adapter for, by its name."""
    from importlib.metadata import entry_points  # few states have objects in C

    entries = list(entry_points(group="physx.states", name=name))
    if not entries:
        return None
    KINDS[name] = _Adapted(entries[0].load()())
    return name


def read_attributes(value: Any, part: Part, left_out: frozenset[str] = frozenset()) -> Any:
    """Return the attributes of an object as parts, by name, but for what is computed from them."""
    own = getattr(value, "__dict__", {})
    left_out = left_out | cached_of(class_of(value))
    found = {name: part(own[name], f".{name}") for name in own if name not in left_out}
    for name in slots_of(class_of(value)):
        if hasattr(value, name):
            found[name] = part(getattr(value, name), f".{name}")
    return found


def _cells(function: FunctionType) -> Iterator[tuple[str, Any]]:
    return zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)


def _check_bare(value: Any) -> None:
    """Check that items are all that a list or dictionary of a class of its own has."""
    if getattr(value, "__dict__", None):
        raise RefusedError("has both items and attributes")


def as_lists(state: Any) -> Any:
    """Return the state of a bit generator with lists instead of arrays."""
    if isinstance(state, dict):
        return {name: as_lists(each) for name, each in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state
