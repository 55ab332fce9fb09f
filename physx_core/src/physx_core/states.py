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
from hashlib import blake2b
from pathlib import PurePath
from types import (
    BuiltinFunctionType,
    FunctionType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any, TypeAlias

import numpy as np

from physx_core.config import SCRIPT_PREFIX
from physx_core.errors import StateError, listed
from physx_core.typing import Array

Part: TypeAlias = Callable[[Any, str], Any]
"""Returns what stands for a part in a content: atoms themselves, the number of an object as a tuple
``(number,)``. Takes the part and where it is."""
Value: TypeAlias = Callable[[Any], Any]
"""Returns the part that an atom or number stands for."""

_ATOMS = frozenset((type(None), bool, int, float, complex, str, bytes))
_PLAIN = "biufcSUmM"
"""Kinds of dtypes that values of any process understand."""
_BITS = {
    kind.__name__: kind
    for kind in (
        *(np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM),
        *(np.random.Philox, np.random.SFC64),
    )
}
_BASES = {each.__name__: each for each in (dict, list, tuple, set, frozenset, deque, object)}

_digest = functools.partial(blake2b, digest_size=7)  # fits a whole number of 8 bytes


class Baseline:
    """The parts of an object as they were when it was created, by number.

    Known are numbers, texts, bytes, paths, NumPy arrays and their views, random generators, lists,
    dictionaries, tuples, sets, deques, members of enumerations, objects of Python classes with
    their attributes, their methods, what functions remember, and any object with methods
    ``snapshot()`` and ``restore(snapshot)``, such as the simulations of engines.
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

    def leave_out(self, names: Iterable[str]) -> None:
        """Leave attributes out that the object has got since."""
        self._left_out |= frozenset(names)

    def capture(self) -> dict[str, Any]:
        """Return what has changed, as values that `physx_core.net.encode` takes.

        Objects with a ``snapshot`` method are asked for one, which may change what they do next in
        the last bits: see `physx_sim.Simulation.snapshot`.

        Raises:
            StateError: If a part is of an unknown kind.
        """
        graph, known = _Graph(self._left_out, self._nodes, self._numbers), len(self._nodes)
        graph.walk(self._nodes[0])
        changed, added = [], []
        for number, content in sorted(graph.contents.items()):
            if number >= known:
                added.append([*graph.recipe(number), content])
            elif not _same(content, self._contents[number]):
                changed.append([number, content])
        created = {"names": self._names, "created": self._created.copy()}
        return {**created, "changed": changed, "added": added}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Change the object to a state of it, or of another one that was created alike.

        Raises:
            StateError: If it was created differently, or a class of the state is not imported.
        """
        self._check_created(state)
        contents = self._contents | dict(state["changed"])
        added, first = state["added"], len(self._nodes)
        contents |= {number: content for number, (_, _, content) in enumerate(added, first)}
        made = _Making(self._nodes, added)
        try:
            nodes = [made(number) for number in range(first + len(added))]
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise StateError(f"The state is damaged: {error!r:.200}.") from error
        kinds = ["object", *map(_kind_of, nodes[1:])]

        def fill() -> None:
            for later in (False, True):  # what has a hash comes before what needs it
                for number, content in contents.items():
                    kind = _KINDS[kinds[number]]
                    if kind.hashes is later:
                        kept = frozenset() if number else self._left_out
                        kind.fill(nodes[number], content, made.value, kept)

        fill()
        for number, content in contents.items():
            if kinds[number] == "snapshot" and content is not None:
                nodes[number].restore(made.value(content))
        fill()  # what restoring a snapshot has changed around it

    def _check_created(self, state: Mapping[str, Any]) -> None:
        here, there = (
            dict(zip(names.splitlines(), digests.tolist(), strict=True))
            for names, digests in (
                (self._names, self._created),
                (state["names"], state["created"]),
            )
        )
        differ = [name for name in {**here, **there} if here.get(name) != there.get(name)]
        if differ:
            root = type(self._nodes[0]).__name__
            raise StateError(
                f"The state is of another {root}: after creation, these attributes differ: "
                f"{listed(differ)}. Create it with the same arguments, seed and code, and name "
                'what may differ in the class: constants = ("name",).'
            )


class _Graph:
    """Objects by number, and the contents of those that can be reached."""

    def __init__(
        self,
        left_out: frozenset[str],
        nodes: Iterable[Any] = (),
        numbers: Mapping[int, int] | None = None,
    ) -> None:
        self.nodes, self.numbers = list(nodes), dict(numbers or {})  # number by id
        self.contents: dict[int, Any] = {}
        self._left_out, self._known = left_out, len(self.nodes)
        self._queue: list[int] = []
        self._origins: dict[int, tuple[int, str]] = {}  # by number: who has it, and where

    def walk(self, root: Any, *, with_snapshots: bool = True) -> None:
        """Read the contents of all objects that can be reached."""
        self._part(-1, root, type(root).__name__)
        for number in self._queue:  # which grows
            value, part = self.nodes[number], functools.partial(self._part, number)
            try:
                if not number:
                    content: Any = _read_attributes(value, part, self._left_out)
                elif _kind_of(value) == "snapshot" and not with_snapshots:
                    content = None
                else:
                    content = _KINDS[_kind_of(value)].read(value, part)
            except _RefusedError as error:
                raise self._error(number, str(error)) from None
            self.contents[number] = content

    def recipe(self, number: int) -> tuple[str, Any]:
        """Return the kind of an added object, and what is needed to make it."""
        value = self.nodes[number]
        kind = _kind_of(value)
        try:
            return kind, _KINDS[kind].recipe(value)
        except _RefusedError as error:
            raise self._error(number, str(error)) from None

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
                digest = found.setdefault(name, _digest())
                digest.update(text.encode() + _as_bytes(content))
        root = self.contents[0]
        for name, part in root.items():
            found.setdefault(name, _digest(_as_bytes([part])))
        return {name: int.from_bytes(found[name].digest(), "little") for name in root}

    def _part(self, owner: int, value: Any, label: str) -> Any:
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

    def _error(self, number: int, why: str) -> StateError:
        labels, place = [], number
        while place >= 0:
            place, label = self._origins[place]
            labels.append(label)
        path, name = "".join(reversed(labels)), "".join(labels[-2:-1]).removeprefix(".")
        kind = _name_of(type(self.nodes[number])).replace(":", ".")
        return StateError(
            f"{path} ({kind}) {why}, so there can be no state of it. If it never changes, name it "
            f'in the class: constants = ("{name}",). Otherwise implement get_state() and '
            "set_state(state), or give its class methods snapshot() and restore(snapshot).",
            path,
            kind,
        )


class _Making:
    """Makes the added objects of a state, still empty unless they consist of their parts."""

    def __init__(self, nodes: list[Any], added: list[Any]) -> None:
        self._nodes, self._first, self._added = [*nodes, *([None] * len(added))], len(nodes), added
        self._is_made = [True] * len(nodes) + [False] * len(added)

    def __call__(self, number: int) -> Any:
        if not self._is_made[number]:
            kind, recipe, content = self._added[number - self._first]
            self._nodes[number] = _KINDS[kind].make(recipe, content, self.value)
            self._is_made[number] = True
        return self._nodes[number]

    def value(self, part: Any) -> Any:
        return self(part[0]) if type(part) is tuple else part


# Kinds ------------------------------------------------------------------------------------------


class _RefusedError(Exception):
    """Why there can be no state of an object."""


class _Kind:
    """What is done with objects of a kind; here: with those that never change.

    Attributes:
        hashes: Whether filling them needs the hash of parts.
    """

    hashes = False

    def read(self, value: Any, part: Part) -> Any:
        """Return the content: a list or dictionary of parts, an array, bytes, or an atom."""
        return getattr(value, "__qualname__", None) or getattr(value, "__name__", str(value))

    def recipe(self, value: Any) -> Any:
        """Return what is needed to make an object, besides its content."""
        raise _RefusedError("was added after creation")

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        """Return a new object, empty if `fill` fills it."""
        raise StateError("The state has an object that cannot be made.")

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        """Give an object its content, in place."""


class _Unknown(_Kind):
    def read(self, value: Any, part: Part) -> Any:
        raise _RefusedError("cannot be captured")


class _Snapshot(_Kind):
    def read(self, value: Any, part: Part) -> Any:
        return part(value.snapshot(), ".snapshot()")


class _Object(_Kind):
    """An object of a Python class, with attributes."""

    def read(self, value: Any, part: Part) -> Any:
        return _read_attributes(value, part)

    def recipe(self, value: Any) -> Any:
        return _recipe_of(_class_of(value), object)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return _new(recipe, object)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        values = {name: value(part) for name, part in content.items()}
        own = getattr(node, "__dict__", {})
        for name in own.keys() - values.keys() - kept:
            del own[name]
        for name in _slots(_class_of(node)):
            if name in values:
                object.__setattr__(node, name, values.pop(name))
            elif hasattr(node, name):
                object.__delattr__(node, name)
        own.update(values)


class _Items(_Kind):
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
        return _recipe_of(_class_of(value), self._base)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        if self._base is deque:
            return deque(maxlen=recipe)
        items = [[value(part) for part in content]] if self._is_fixed else []
        return _new(recipe, self._base, *items)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        if not self._is_fixed:
            base: Any = self._base  # a class may have methods of its own
            base.clear(node)
            (base.update if base is set else base.extend)(node, [value(part) for part in content])


class _Dict(_Kind):
    hashes = True

    def read(self, value: Any, part: Part) -> Any:
        _check_bare(value)
        return [
            found
            for key, each in value.items()
            for found in (part(key, " key"), part(each, f"[{key!r:.40}]"))
        ]

    def recipe(self, value: Any) -> Any:
        return _recipe_of(_class_of(value), dict)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return _new(recipe, dict)

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        parts = [value(part) for part in content]
        base: Any = OrderedDict if isinstance(node, OrderedDict) else dict
        base.clear(node)  # a class may have methods of its own
        for key, each in zip(parts[::2], parts[1::2], strict=True):
            base.__setitem__(node, key, each)


class _Array(_Kind):
    """An array that has its own memory; its axes stay in their order there."""

    def read(self, value: Any, part: Part) -> Any:
        if value.dtype.hasobject:
            raise _RefusedError(f"of {value.dtype} cannot be captured")
        copied = np.array(value.transpose(_axes(value)), order="C")
        return copied if value.dtype.kind in _PLAIN else copied.tobytes()

    def recipe(self, value: Any) -> Any:
        if value.size and type(value.base) not in (type(None), bytes, bytearray, memoryview):
            raise _RefusedError(f"is memory of a {type(value.base).__name__}: store a copy of it")
        return [_axes(value), list(value.shape), _descr(value.dtype), value.flags.writeable]

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        axes, shape, descr, writeable = recipe
        lying = np.empty([shape[axis] for axis in axes], _dtype(descr))
        found = np.empty_like(lying.transpose(np.argsort(axes)))  # no view
        self.fill(found, content, value, frozenset())
        found.flags.writeable = writeable
        return found

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        whole = node.transpose(_axes(node))
        if isinstance(content, bytes):
            content = np.frombuffer(content, node.dtype).reshape(whole.shape)
        if whole.shape != content.shape:
            raise StateError(f"The shape of an array was changed in place, to {content.shape}.")
        if not node.flags.writeable and whole.tobytes() == content.tobytes():
            return
        writeable, node.flags.writeable = node.flags.writeable, True
        node.transpose(_axes(node))[...] = content
        node.flags.writeable = writeable


class _View(_Kind):
    """A view of an array, which has its content."""

    def read(self, value: Any, part: Part) -> Any:
        whole = _whole(value)
        offset = _address(value) - _address(whole)
        return [part(whole, ".base"), offset, str(value.strides), str(value.shape)]

    def recipe(self, value: Any) -> Any:
        return [list(value.shape), list(value.strides), _descr(value.dtype), value.flags.writeable]

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        whole, (shape, strides, descr, writeable) = value(content[0]), recipe
        whole = whole.transpose(_axes(whole))
        found: Array = np.ndarray(shape, _dtype(descr), whole, content[1], strides)
        found.flags.writeable &= writeable
        return found


class _Bits(_Kind):
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


class _Generator(_Kind):
    def read(self, value: Any, part: Part) -> Any:
        return [part(value.bit_generator, ".bit_generator")]

    def recipe(self, value: Any) -> Any:
        return None

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return np.random.Generator(value(content[0]))


class _Dtype(_Kind):
    """A dtype, such as one that an object computes when it is first needed."""

    def recipe(self, value: Any) -> Any:
        if value.hasobject:
            raise _RefusedError("was added after creation")
        return _descr(value)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return _dtype(recipe)


class _Enum(_Kind):
    def read(self, value: Any, part: Part) -> Any:
        return part(value.value, ".value")

    def recipe(self, value: Any) -> Any:
        return _recipe_of(_class_of(value), enum.Enum)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return _class_named(recipe, enum.Enum)(value(content))


class _Function(_Kind):
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
            raise _RefusedError("is not a method of its class")
        return name

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        owner = value(content["__self__"])
        function = getattr(type(owner), recipe)
        if not isinstance(function, FunctionType):
            raise StateError(f"{type(owner).__name__} has no method {recipe}().")
        return MethodType(function, owner)


_KINDS: dict[str, _Kind] = {
    **{base.__name__: _Items(base) for base in (list, tuple, set, frozenset, deque)},
    "dict": _Dict(),
    "object": _Object(),
    "array": _Array(),
    "view": _View(),
    "bits": _Bits(),
    "generator": _Generator(),
    "dtype": _Dtype(),
    "enum": _Enum(),
    "function": _Function(),
    "method": _Method(),
    "snapshot": _Snapshot(),
    "fixed": _Kind(),
    "unknown": _Unknown(),
}
_OF_TYPES: tuple[tuple[Any, str], ...] = (
    (enum.Enum, "enum"),
    (MethodType, "method"),
    ((FunctionType, BuiltinFunctionType, functools.partial), "function"),
    (np.dtype, "dtype"),
    ((type, ModuleType, np.ufunc, range, slice, re.Pattern), "fixed"),
)


def _kind_of(value: Any) -> str:
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
    slots = 0 if kind is base else len(_slots(kind))
    words = slots + (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
    is_known = kind.__basicsize__ <= base.__basicsize__ + 8 * words
    is_known &= kind is not object and (base is not deque or kind is deque)
    if kind is OrderedDict or (is_known and (base is object or not slots)):
        return base.__name__
    return "unknown"


@functools.cache
def _slots(kind: Any) -> list[str]:
    members = [(name, what) for each in kind.__mro__ for name, what in vars(each).items()]
    return [
        name
        for name, what in members
        if isinstance(what, MemberDescriptorType) and name != "__dict__"
    ]


def _read_attributes(value: Any, part: Part, left_out: frozenset[str] = frozenset()) -> Any:
    own = getattr(value, "__dict__", {})
    found = {name: part(own[name], f".{name}") for name in own if name not in left_out}
    for name in _slots(_class_of(value)):
        if hasattr(value, name):
            found[name] = part(getattr(value, name), f".{name}")
    return found


def _cells(function: FunctionType) -> Iterator[tuple[str, Any]]:
    return zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)


def _check_bare(value: Any) -> None:
    """Check that items are all that a list or dictionary of a class of its own has."""
    if getattr(value, "__dict__", None):
        raise _RefusedError("has both items and attributes")


@functools.cache
def _recipe_of(kind: Any, base: Any) -> str | None:
    """Return the name of a class; None if it is the base itself."""
    if kind is base:
        return None
    name = _name_of(kind)
    try:
        if _class_named(name, base) is kind and (base is enum.Enum or _new(name, base) is not None):
            return name
    except (StateError, TypeError):
        pass
    raise _RefusedError("is of a class that cannot be found and made by its name, or has __del__")


def _class_named(name: str, base: type[Any]) -> Any:
    """Return a class that is imported, and whose objects run no code when they are made or end."""
    module, _, qualified = name.partition(":")
    found = _module_named(module)
    for each in qualified.split("."):
        found = vars(found).get(each) if hasattr(found, "__dict__") else None
    is_class = isinstance(found, type) and issubclass(found, base)
    if not is_class or hasattr(found, "__del__"):
        raise StateError(
            f"The state has an object of {name.replace(':', '.')}, which is not a class of an "
            "imported module, or defines __del__: import it where the environment is defined."
        )
    return found


def _new(name: str | None, base: Any, *items: Any) -> Any:
    """Return an object of a class by its name, made without any method of that class."""
    kind = base if name is None else _class_named(name, base)
    make = base.__new__ if isinstance(kind.__new__, FunctionType) else kind.__new__
    return make(kind, *items)


def _class_of(value: Any) -> Any:
    return type(value)


def _name_of(kind: type[Any]) -> str:
    return f"{_file_or_module(kind.__module__)}:{kind.__qualname__}"


def _file_or_module(module: str) -> str:
    """Return the name of a module; of a script's file, as its module has many names."""
    file = getattr(sys.modules.get(module), "__file__", None)
    is_script = module == "__main__" or module.startswith(SCRIPT_PREFIX)
    return PurePath(file).name if is_script and file else module


def _module_named(name: str) -> Any:
    if name in sys.modules or not name.endswith(".py"):
        return sys.modules.get(name)
    names = (each for each in list(sys.modules) if _file_or_module(each) == name)
    return sys.modules.get(next(names, ""))


def _axes(array: Array) -> list[int]:
    """Return the axes from the longest to the shortest stride."""
    return sorted(range(array.ndim), key=lambda axis: -array.strides[axis])


def _whole(view: Any) -> Any:
    while type(view.base) is np.ndarray:
        view = view.base
    return view


def _address(array: Array) -> int:
    return int(array.__array_interface__["data"][0])


def _descr(dtype: np.dtype[Any]) -> Any:
    return dtype.str if dtype.kind in _PLAIN else dtype.descr


def _dtype(descr: Any) -> Any:
    return np.dtype(descr if isinstance(descr, str) else [tuple(each) for each in descr])


def as_lists(state: Any) -> Any:
    """Return the state of a bit generator with lists instead of arrays."""
    if isinstance(state, dict):
        return {name: as_lists(each) for name, each in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


# Comparing --------------------------------------------------------------------------------------


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
        return bool(one.shape == other.shape and one.tobytes() == other.tobytes())
    if repr(one) != repr(other):
        return False
    return list(map(type, _parts(one))) == list(map(type, _parts(other)))
