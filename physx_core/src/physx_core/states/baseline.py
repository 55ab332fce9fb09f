"""Baseline: the graph of an object as it was created, and what has changed in it since."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from pathlib import PurePath
from typing import Any

import numpy as np

from physx_core.errors import StateError, listed
from physx_core.states.classes import name_of
from physx_core.states.kind import PLAIN, RefusedError
from physx_core.states.kinds import KINDS, kind_of, read_attributes

_ATOMS = frozenset((type(None), bool, int, float, complex, str, bytes))

_digest = functools.partial(blake2b, digest_size=7)  # fits a whole number of 8 bytes


class Baseline:
    """The parts of an object as they were when it was created, by number.

    Known are numbers, texts, bytes, paths, NumPy arrays and their views, random generators, lists,
    dictionaries, tuples, sets, deques, members of enumerations, objects of Python classes with
    their attributes, their methods, what functions remember, any object with methods
    ``snapshot()`` and ``restore(snapshot)``, such as the simulations of engines, and objects in C
    that an installed package has a `StateAdapter` for.
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
        kinds = ["object", *map(kind_of, nodes[1:])]

        def fill() -> None:
            for later in (False, True):  # what has a hash comes before what needs it
                for number, content in contents.items():
                    kind = KINDS[kinds[number]]
                    if kind.hashes is later:
                        kept = frozenset() if number else self._left_out
                        kind.fill(nodes[number], content, made.value, kept)

        fill()
        for number, content in contents.items():
            KINDS[kinds[number]].settle(nodes[number], content, made.value)
        fill()  # what that has changed around it

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
                    content: Any = read_attributes(value, part, self._left_out)
                elif kind_of(value) == "snapshot" and not with_snapshots:
                    content = None
                else:
                    content = KINDS[kind_of(value)].read(value, part)
            except RefusedError as error:
                raise self._error(number, str(error)) from None
            self.contents[number] = content

    def recipe(self, number: int) -> tuple[str, Any]:
        """Return the kind of an added object, and what is needed to make it."""
        value = self.nodes[number]
        kind = kind_of(value)
        try:
            return kind, KINDS[kind].recipe(value)
        except RefusedError as error:
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
                text = f"{number} {label} {name_of(type(self.nodes[number]))} "
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
        if isinstance(value, np.generic) and value.dtype.kind in PLAIN:
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
        kind = name_of(type(self.nodes[number])).replace(":", ".")
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
            self._nodes[number] = KINDS[kind].make(recipe, content, self.value)
            self._is_made[number] = True
        return self._nodes[number]

    def value(self, part: Any) -> Any:
        return self(part[0]) if type(part) is tuple else part


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
