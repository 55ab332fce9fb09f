"""States: what has changed in an object since it was created, as plain values.

An object is the graph of what it holds. `Baseline` numbers that graph once, right after creation,
so that the same object in another process has the same numbers. A state has the new contents of
numbered objects, which are restored in place, and the objects that have been added since. It holds
no code, and restoring it runs none but the `restore` of objects that have a `snapshot` themselves.
"""

from __future__ import annotations

import enum
import functools
import re
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import PurePath
from types import (
    BuiltinFunctionType,
    FunctionType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import numpy as np
import xxhash

from physx_core.errors import StateError, listed
from physx_core.typing import Array

_ATOMS = frozenset((type(None), bool, int, float, complex, str, bytes))
_PLAIN = "biufcSUmM"
"""Kinds of dtypes that values of any process understand."""
_BASES = (dict, list, tuple, set, frozenset, deque, object)
_NUMPY = (np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox,
          np.random.SFC64)  # fmt: skip
_BITS = {kind.__name__: kind for kind in _NUMPY}
_FIXED = (type, ModuleType, np.dtype, np.ufunc, range, slice, re.Pattern)
_FUNCTIONS = (FunctionType, MethodType, BuiltinFunctionType, functools.partial)
_BUFFERS = (type(None), bytes, bytearray, memoryview)
_IN_PARTS = ("tuple", "frozenset", "generator")
"""Kinds of objects that are made of their parts, and do not change."""
_HASHING = ("dict", "set")
_ORDERED = "collections:OrderedDict"


class Baseline:
    """The parts of an object as they were when it was created, by number.

    Known are numbers, texts, bytes, paths, NumPy arrays, random generators and bit generators,
    lists, dictionaries, tuples, sets, deques, members of enumerations, objects of Python classes,
    with their attributes, and any object with methods ``snapshot()`` and ``restore(snapshot)``,
    such as the simulations of engines.
    """

    def __init__(self, root: Any, left_out: Iterable[str] = ()) -> None:
        """Copy the contents of an object, and of all objects in it.

        Args:
            root: The object.
            left_out: Names of its attributes that are not part of states.

        Raises:
            StateError: If a part is of an unknown kind.
        """
        self._left_out = frozenset(left_out)
        graph = _Graph(self._left_out)
        graph.walk(root, with_snapshots=False)
        self._nodes, self._numbers = graph.nodes, graph.numbers
        self._contents = graph.contents
        digests = graph.digests()
        self._names = "\n".join(digests)
        self._created = np.array(list(digests.values()), np.uint64)

    def capture(self) -> dict[str, Any]:
        """Return what has changed, as values that `physx_core.net.encode` takes.

        Objects with a ``snapshot`` method are asked for one, which may change what they do next in
        the last bits: see `physx_sim.Simulation.snapshot`.

        Raises:
            StateError: If a part is of an unknown kind, or an array added since then is a view of
                another one.
        """
        graph, known = _Graph(self._left_out, self._nodes, self._numbers), len(self._nodes)
        graph.walk(self._nodes[0])
        changed, added = [], []
        for number, content in sorted(graph.contents.items()):
            if number >= known:
                added.append([*graph.describe(number), content])
            elif not _same(content, self._contents[number]):
                changed.append([number, content])
        return {"created": self._created.copy(), "names": self._names, "changed": changed, "added": added}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Change the object to a state of it, or of another one that was created alike.

        Raises:
            StateError: If it was created differently, or a class of the state is not imported.
        """
        here = _digests(self._names, self._created)
        there = _digests(state["names"], state["created"])
        differ = [name for name in {**here, **there} if here.get(name) != there.get(name)]
        if differ:
            root = type(self._nodes[0]).__name__
            raise StateError(
                f"The state is of another {root}: after creation, these attributes differ: "
                f"{listed(differ)}. Create it with the same arguments, seed and code, and name "
                f"what may differ in the class: constants = ({differ[0]!r},)."
            )
        contents = self._contents | dict(state["changed"])
        first = len(self._nodes)
        for number, (_, _, content) in enumerate(state["added"], first):
            contents[number] = content
        made = _Making(self._nodes, state["added"])
        nodes = [made(number) for number in range(first + len(state["added"]))]
        kinds = ["object", *map(_kind_of, nodes[1:])]

        def fill() -> None:
            for later in (False, True):  # what has a hash comes before what needs it
                for number, content in contents.items():
                    if (kinds[number] in _HASHING) is later:
                        kept = frozenset() if number else self._left_out
                        _fill(nodes[number], kinds[number], content, made.value, kept)

        fill()
        for number, content in contents.items():
            if kinds[number] == "snapshot" and content is not None:
                nodes[number].restore(made.value(content))
        fill()  # what restoring a snapshot has changed around it


def _digests(names: str, digests: Array) -> dict[str, int]:
    return dict(zip(names.split("\n"), digests.tolist(), strict=True))


# Reading ----------------------------------------------------------------------------------------


class _Graph:
    """Objects by number, and the contents of those that can be reached.

    In a content, a part is an atom, or the number of an object as a tuple ``(number,)``.
    """

    def __init__(
        self,
        left_out: frozenset[str],
        nodes: Iterable[Any] = (),
        numbers: Mapping[int, int] | None = None,
    ) -> None:
        self.nodes, self.numbers = list(nodes), dict(numbers or {})  # number by id
        self.contents: dict[int, Any] = {}
        self._queue: list[int] = []
        self._known, self._left_out = len(self.nodes), left_out
        self._origins: dict[int, tuple[int, str]] = {}  # by number: who has it, and where
        self._memory: dict[int, int] = {}  # number of an array by the id of what owns its memory

    def walk(self, root: Any, *, with_snapshots: bool = True) -> None:
        """Read the contents of all objects that can be reached."""
        self._part(root, -1, type(root).__name__)
        for number in self._queue:  # which grows
            self.contents[number] = self._content(number, with_snapshots)

    def describe(self, number: int) -> tuple[str, Any]:
        """Return the kind of an added object and what is needed to make it."""
        value = self.nodes[number]
        kind = _kind_of(value)
        if kind == "array":
            return kind, [_axes(value), value.flags.writeable, _descr(value.dtype),
                          list(value.shape)]  # fmt: skip
        if kind == "bits":
            sequence = value.seed_seq
            return kind, [type(value).__name__, None if sequence is None else sequence.state]
        if kind == "deque":
            return kind, value.maxlen
        if kind in ("function", "fixed", "snapshot"):
            raise self._error(number, "was added after creation")
        if kind == "generator":
            return kind, None
        return kind, None if type(value).__module__ == "builtins" else _name_of(type(value))

    def digests(self) -> dict[str, int]:
        """Return a digest of the contents below each attribute of the root."""
        found: dict[str, Any] = {}
        for number, content in self.contents.items():
            top, (owner, label) = number, self._origins[number]
            while owner > 0:
                top, (owner, _) = owner, self._origins[owner]
            if number:
                name = self._origins[top][1].removeprefix(".")
                text = f"{number} {label} {_name_of(type(self.nodes[number]))} "
                digest = found.setdefault(name, xxhash.xxh3_64())
                digest.update(text.encode() + _as_bytes(content))
        root = self.contents[0]
        for name, part in root.items():
            found.setdefault(name, xxhash.xxh3_64(_as_bytes([part])))
        return {name: found[name].intdigest() for name in root}

    def _part(self, value: Any, owner: int, label: str) -> Any:
        """Return an atom itself, and the number of any other object."""
        if type(value) in _ATOMS or isinstance(value, PurePath):
            return value
        if isinstance(value, np.generic) and value.dtype.kind in _PLAIN:
            return value
        number = self.numbers.get(id(value))
        if number is None:
            number = self.numbers[id(value)] = len(self.nodes)
            self.nodes.append(value)
        if number not in self._origins:
            self._origins[number] = owner, label
            self._queue.append(number)
        return (number,)

    def _content(self, number: int, with_snapshots: bool) -> Any:
        value = self.nodes[number]
        kind = _kind_of(value) if number else "object"
        if kind == "object":
            left_out = frozenset() if number else self._left_out
            parts = {name: each for name, each in _attributes(value) if name not in left_out}
            return {name: self._part(each, number, f".{name}") for name, each in parts.items()}
        if kind == "dict":
            return [
                part
                for key, each in value.items()
                for part in (
                    self._part(key, number, " key"),
                    self._part(each, number, f"[{key!r:.40}]"),
                )
            ]
        if kind in ("set", "frozenset"):  # the order may differ between processes
            value = sorted(value, key=repr)
        if kind in ("list", "tuple", "deque", "set", "frozenset"):
            return [self._part(each, number, f"[{i}]") for i, each in enumerate(value)]
        if kind == "array":
            return self._array(number, value)
        if kind == "generator":
            return [self._part(value.bit_generator, number, ".bit_generator")]
        if kind == "bits":
            return [as_lists(value.state), getattr(value.seed_seq, "n_children_spawned", 0)]
        if kind == "enum":
            return self._part(value.value, number, ".value")
        if kind == "function":
            return {name: self._part(each, number, f".{name}") for name, each in _needs(value)}
        if kind == "snapshot":
            return self._part(value.snapshot(), number, ".snapshot()") if with_snapshots else None
        if kind == "fixed":
            return getattr(value, "__qualname__", None) or getattr(value, "__name__", str(value))
        raise self._error(number, "cannot be captured")

    def _array(self, number: int, value: Array) -> Any:
        if value.dtype.hasobject:
            raise self._error(number, f"of {value.dtype} cannot be captured")
        whole: Any = value
        while isinstance(whole.base, np.ndarray):
            whole = whole.base
        other = self._memory.setdefault(id(whole), number)
        is_added = number >= self._known > 0
        if self._known and other != number and max(number, other) >= self._known:
            added, seen = max(number, other), min(number, other)
            raise self._error(added, f"is a view of {self._path(seen)}: store a copy of it")
        if is_added and type(whole.base) not in _BUFFERS:
            what = type(whole.base).__name__
            raise self._error(number, f"is a view of memory of a {what}: store a copy of it")
        if is_added and not value.transpose(_axes(value)).flags.c_contiguous:
            raise self._error(number, "is a view with gaps: store a copy of it")
        copied = np.array(value.transpose(_axes(value)) if is_added else value, order="C")
        return copied if value.dtype.kind in _PLAIN else copied.tobytes()

    def _path(self, number: int) -> str:
        labels: list[str] = []
        while number >= 0:
            number, label = self._origins[number]
            labels.append(label)
        return "".join(reversed(labels))

    def _error(self, number: int, why: str) -> StateError:
        path, kind = self._path(number), _name_of(type(self.nodes[number])).replace(":", ".")
        name = path.split(".")[1].split("[")[0] if "." in path else path
        return StateError(
            f"{path} ({kind}) {why}, so there can be no state of it. If it never changes, name it "
            f'in the class: constants = ("{name}",). Otherwise implement get_state() and '
            "set_state(state), or give its class methods snapshot() and restore(snapshot).",
            path,
            kind,
        )


def _kind_of(value: Any) -> str:
    kind = type(value)
    if kind is np.ndarray:
        return "array"
    if kind is np.random.Generator:
        return "generator"
    if kind in _NUMPY:
        return "bits"
    if isinstance(value, enum.Enum):
        return "enum"
    if isinstance(value, _FUNCTIONS):
        return "function"
    if isinstance(value, _FIXED):
        return "fixed"
    return _kind_of_class(kind)


@functools.cache
def _kind_of_class(kind: Any) -> str:
    """Return the kind of a class's objects; "unknown" if they have memory of their own in C."""
    if all(callable(getattr(kind, name, None)) for name in ("snapshot", "restore")):
        return "snapshot"
    if kind is OrderedDict:
        return "dict"
    base = next(each for each in _BASES if issubclass(kind, each))
    slots = 0 if kind is base else len(_slots(kind))
    words = slots + (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
    is_known = kind.__basicsize__ <= base.__basicsize__ + 8 * words and kind is not object
    if not is_known or (base is not object and slots):
        return "unknown"
    return "object" if base is object else base.__name__


@functools.cache
def _slots(kind: Any) -> list[str]:
    return [name for each in kind.__mro__ for name, what in vars(each).items()
            if isinstance(what, MemberDescriptorType)]  # fmt: skip


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    yield from getattr(value, "__dict__", {}).items()
    for name in _slots(type(value)):
        if hasattr(value, name):
            yield name, getattr(value, name)


def _needs(function: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a function refers to, but for module variables."""
    if isinstance(function, functools.partial):
        yield from (("func", function.func), ("args", function.args))
        yield "keywords", function.keywords
    elif isinstance(function, FunctionType):
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        yield from ((name, cell.cell_contents) for name, cell in cells)
    elif not isinstance(function.__self__, ModuleType):
        yield "__self__", function.__self__


def _axes(array: Array) -> list[int]:
    """Return the axes from the longest to the shortest stride."""
    return sorted(range(array.ndim), key=lambda axis: -array.strides[axis])


def _descr(dtype: np.dtype[Any]) -> Any:
    return dtype.str if dtype.kind in _PLAIN else dtype.descr


def _name_of(kind: type[Any]) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def as_lists(state: Any) -> Any:
    """Return the state of a bit generator with lists instead of arrays."""
    if isinstance(state, dict):
        return {name: as_lists(each) for name, each in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def _parts(content: Any) -> list[Any]:
    if isinstance(content, list):
        return content
    return list(content.values()) if isinstance(content, dict) else [content]


def _as_bytes(content: Any) -> bytes:
    """Return a content as bytes that are the same in each process; paths differ."""
    if isinstance(content, np.ndarray):
        return f"{content.dtype}{content.shape}".encode() + content.tobytes()
    parts = ["path" if isinstance(each, PurePath) else each for each in _parts(content)]
    return repr((parts, list(content) if isinstance(content, dict) else None)).encode()


def _same(one: Any, other: Any) -> bool:
    """Return whether contents are equal in type and bits."""
    if isinstance(one, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if repr(one) != repr(other):
        return False
    return list(map(type, _parts(one))) == list(map(type, _parts(other)))


# Restoring --------------------------------------------------------------------------------------


class _Making:
    """Makes the added objects of a state, still empty unless they consist of their parts."""

    def __init__(self, nodes: list[Any], added: list[Any]) -> None:
        self._nodes, self._first, self._added = [*nodes, *([None] * len(added))], len(nodes), added
        self._is_made = [True] * len(nodes) + [False] * len(added)

    def __call__(self, number: int) -> Any:
        if not self._is_made[number]:
            self._nodes[number] = self._made(*self._added[number - self._first])
            self._is_made[number] = True
        return self._nodes[number]

    def value(self, part: Any) -> Any:
        return self(part[0]) if type(part) is tuple else part

    def _made(self, kind: str, how: Any, content: Any) -> Any:
        if kind == "array":
            return _new_array(*how, content)
        if kind == "bits":
            name, seeds = how
            return _BITS[name](None if seeds is None else np.random.SeedSequence(**seeds))
        if kind == "generator":
            return np.random.Generator(self.value(content[0]))
        if kind == "deque":
            return deque(maxlen=how)
        if kind == "enum":
            return _class_named(how, enum.Enum)(self.value(content))
        if how == _ORDERED:
            return OrderedDict()
        base = {each.__name__: each for each in _BASES}[kind]
        made: Any = base if how is None else _class_named(how, base)
        if kind in _IN_PARTS:
            return base.__new__(made, [self.value(part) for part in content])
        return base.__new__(made)


def _new_array(axes: list[int], writeable: bool, descr: Any, shape: list[int], content: Any) -> Any:
    found = content
    if isinstance(content, bytes):
        dtype = np.dtype([tuple(each) for each in descr])
        found = np.frombuffer(bytearray(content), dtype).reshape([shape[axis] for axis in axes])
    found = np.array(found).transpose(np.argsort(axes))
    found.flags.writeable = writeable
    return found


def _class_named(name: str, base: type[Any]) -> Any:
    """Return a class that is imported, and whose objects are made without any code of its own."""
    module, _, qualified = name.partition(":")
    found: Any = sys.modules.get(module)
    for each in qualified.split("."):
        found = None if found is None else vars(found).get(each)
    is_class = isinstance(found, type) and issubclass(found, base)
    if not is_class or hasattr(found, "__del__"):
        raise StateError(
            f"The state has an object of {name.replace(':', '.')}, which is not a class of an "
            "imported module, or defines __del__: import it where the environment is defined."
        )
    return found


def _fill(
    node: Any, kind: str, content: Any, value: Callable[[Any], Any], kept: frozenset[str]
) -> None:
    """Give an object its content, in place."""
    if kind == "object":
        _fill_attributes(node, {name: value(part) for name, part in content.items()}, kept)
    elif kind == "dict":
        parts = [value(part) for part in content]
        node.clear()
        node.update(zip(parts[::2], parts[1::2], strict=True))
    elif kind == "list":
        node[:] = [value(part) for part in content]
    elif kind in ("set", "deque"):
        node.clear()
        (node.update if kind == "set" else node.extend)(value(part) for part in content)
    elif kind == "array":
        _fill_array(node, content)
    elif kind == "bits":
        node.state, spawned = content
        missing = spawned - getattr(node.seed_seq, "n_children_spawned", 0)
        if missing > 0:
            node.seed_seq.spawn(missing)
    elif isinstance(node, FunctionType):
        for name, cell in zip(node.__code__.co_freevars, node.__closure__ or (), strict=True):
            cell.cell_contents = value(content[name])


def _fill_attributes(node: Any, values: dict[str, Any], kept: frozenset[str]) -> None:
    own = getattr(node, "__dict__", {})
    for name in own.keys() - values.keys() - kept:
        del own[name]
    for name in _slots(type(node)):
        if name in values:
            object.__setattr__(node, name, values.pop(name))
        elif hasattr(node, name):
            object.__delattr__(node, name)
    own.update(values)


def _fill_array(node: Array, content: Any) -> None:
    if isinstance(content, bytes):
        content = np.frombuffer(content, node.dtype).reshape(node.shape)
    if node.shape != content.shape:
        raise StateError(f"An array's shape has been changed in place, to {content.shape}.")
    writeable = node.flags.writeable
    if writeable or node.tobytes() != content.tobytes():
        node.flags.writeable = True
        node[...] = content
        node.flags.writeable = writeable
