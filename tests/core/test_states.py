"""States: what has changed in an object, restored into another one that was created alike."""

from __future__ import annotations

import enum
import functools
import threading
from collections import Counter, OrderedDict, defaultdict, deque
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physx_core.errors import StateError
from physx_core.net import decode, encode
from physx_core.plugins import resolve
from physx_core.states import Baseline


class Node:
    """An object of attributes."""

    def __init__(self, **attributes: Any) -> None:
        vars(self).update(attributes)


@dataclass(frozen=True)
class Frozen:
    first: Any
    second: Any = field(default=())


@dataclass(frozen=True)
class Triangle:
    legs: tuple[float, float]

    @functools.cached_property
    def area(self) -> float:
        return self.legs[0] * self.legs[1] / 2


class Slotted:
    __slots__ = ("__hidden", "shown")

    def __init__(self, shown: Any) -> None:
        self.shown, self.__hidden = shown, [shown]


class Pair(NamedTuple):
    one: Any
    other: Any


class Phase(enum.Enum):
    SWING = 1
    STANCE = "stance"


class Engine:
    """Has memory that only its own methods can read."""

    def __init__(self) -> None:
        self._lock, self._value = threading.Lock(), np.zeros(2)

    def move(self) -> None:
        self._value = self._value + 1

    def snapshot(self) -> Frozen:
        return Frozen(self._value.copy())

    def restore(self, state: Frozen) -> None:
        self._value = state.first.copy()


def restored(source: Baseline, target: Baseline) -> None:
    """Restore a state as another process would get it."""
    target.restore(decode(encode(source.capture(), "state")))


def continued(change: Any, make: Any = Node, **options: Any) -> tuple[Any, Any]:
    """Return a changed object, and another one after its state was restored."""
    one, other = make(), make()
    source, target = Baseline(one, **options), Baseline(other, **options)
    change(one)
    restored(source, target)
    return one, other


# Random graphs ----------------------------------------------------------------------------------

ATOMS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=3),
    st.binary(max_size=3),
    st.builds(np.float32, st.floats(width=32)),
    st.builds(np.int8, st.integers(-9, 9)),
)
DTYPES = ("f8", "f4", "i2", "?", "c16", "U3", "M8[s]", [("a", "f8"), ("b", "i4", 2)])
KINDS = ("list", "dict", "set", "deque", "tuple", "node", "frozen", "slots", "pair", "ordered",
         "view", "array", "generator", "enum")  # fmt: skip
RECIPES = st.lists(
    st.tuples(
        st.sampled_from(KINDS),
        st.integers(0, 99),
        st.lists(ATOMS, max_size=3),
        st.lists(st.integers(0, 9), max_size=3),
    ),
    max_size=8,
)
"""Kind, number, atoms, and which earlier objects each object refers to."""


def array(number: int, size: int) -> np.ndarray:
    dtype = np.dtype(DTYPES[number % len(DTYPES)])
    found = np.zeros([(2, 3, 0)[(number + axis) % 3] for axis in range(size)], dtype)
    values = np.arange(found.size).reshape(found.shape) % 2
    (found["a"] if dtype.names else found)[...] = values
    if number % 3 == 1:
        found = np.array(found.T, order="C").T
    found.flags.writeable = number % 5 != 1
    return found


def generator(number: int) -> np.random.Generator:
    kinds = (np.random.PCG64, np.random.Philox, np.random.MT19937, np.random.SFC64)
    found = np.random.Generator(kinds[number % 4](number))
    found.normal(size=number % 3)
    found.spawn(number % 2)
    return found


def made(kind: str, number: int, atoms: list[Any], parts: list[Any]) -> Any:
    everything = [*atoms, *parts]
    keyed = dict(zip(atoms, parts, strict=False))
    makers = {
        "list": lambda: everything,
        "dict": lambda: keyed,
        "set": lambda: set(atoms),
        "deque": lambda: deque(everything, maxlen=9),
        "tuple": lambda: tuple(everything),
        "node": lambda: Node(**{f"x{i}": each for i, each in enumerate(everything)}),
        "frozen": lambda: Frozen(parts, tuple(parts)),
        "slots": lambda: Slotted(everything),
        "pair": lambda: Pair(atoms, parts),
        "ordered": lambda: OrderedDict(keyed),
        "view": lambda: next(
            (each[::-1] for each in parts if isinstance(each, np.ndarray) and each.ndim), 0
        ),
        "array": lambda: array(number, len(parts)),
        "generator": lambda: generator(number),
        "enum": lambda: list(Phase)[number % 2],
    }
    return makers[kind]()


def build(recipe: list[Any]) -> list[Any]:
    """Return objects that refer to each other in any way, cycles and aliases included."""
    found: list[Any] = []
    for kind, number, atoms, places in recipe:
        parts = [found[place % len(found)] for place in places if found]
        found.append(made(kind, number, list(atoms), parts))
    for each in found:
        if type(each) is list:
            each.append(found[len(each) % len(found)])
    return found


def change(parts: list[Any], others: list[Any]) -> None:
    for part in parts:
        if isinstance(part, np.random.Generator):
            part.normal(size=2)
        elif isinstance(part, np.ndarray) and part.flags.writeable and part.dtype.kind == "f":
            part += 1
        elif isinstance(part, (list, deque)):
            part.insert(0, others[:1])
        elif isinstance(part, Node):
            part.more = others[-1:]


def same(one: Any, other: Any, pairs: dict[int, int]) -> None:
    """Check that two graphs are equal in type, bits, order and aliases."""
    assert type(one) is type(other)
    if id(one) in pairs:
        assert pairs[id(one)] == id(other)
        return
    if isinstance(one, np.generic):
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes())
        return
    if isinstance(one, (type(None), bool, int, float, complex, str, bytes, enum.Enum)):
        assert one is other or repr(one) == repr(other)
        return
    pairs[id(one)] = id(other)
    for pair in zip(parts_of(one), parts_of(other), strict=True):
        same(*pair, pairs)


def parts_of(value: Any) -> list[Any]:
    """Return what must be the same; what is made here is text or bytes, not an object."""
    if isinstance(value, np.ndarray):
        strides = value.strides if value.size else ()
        flags = (value.dtype, value.shape, strides, value.flags.writeable)
        return [repr(flags), value.tobytes(), *([value.base] if value.size else [])]
    if isinstance(value, np.random.Generator):
        bits = value.bit_generator
        copied = type(bits)()
        copied.state = bits.state
        numbers = np.random.Generator(copied).normal(size=3).tobytes()
        return [type(bits).__name__, repr(bits.seed_seq.state), numbers]
    if isinstance(value, (set, frozenset)):
        return sorted(map(repr, value))
    if isinstance(value, dict):
        return [part for pair in value.items() for part in pair]
    if isinstance(value, (list, tuple, deque)):
        return [getattr(value, "maxlen", 0), *value]
    if isinstance(value, Slotted):
        return [value.shown, value._Slotted__hidden]
    return [part for pair in vars(value).items() for part in pair]


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(RECIPES, RECIPES)
def test_random_graphs(recipe, added):
    """Both what is there from the beginning and what is added later, forth and back."""
    one, other = Node(parts=build(recipe)), Node(parts=build(recipe))
    source, target = Baseline(one), Baseline(other)
    first = source.capture()
    others = build(added)
    one.added = [others, one.parts[-1:]]
    change(one.parts, others)
    restored(source, target)
    same(one, other, {})
    last = encode(source.capture(), "state")
    assert encode(target.capture(), "state") == last
    if not any("generator" in each for each in recipe):  # what was spawned stays spawned
        source.restore(first)
        same(one, Node(parts=build(recipe)), {})
        source.restore(decode(last))
        same(one, other, {})


# One by one -------------------------------------------------------------------------------------


def test_aliases_stay_what_they_are():
    def make():
        shared = np.zeros(3)
        return Node(a=shared, view=shared[1:], function=lambda: shared)

    def change(one):
        one.a += 1
        one.view[0], one.new = 7, [one.view]

    one, other = continued(change, make)
    assert other.new[0] is other.view
    assert other.function() is other.a
    assert other.a.tolist() == one.a.tolist() == [1, 7, 1]
    other.a[1] = 9
    assert other.view[0] == 9


def test_engines_by_snapshot():
    one, other = continued(lambda one: one.engine.move(), lambda: Node(engine=Engine()))
    assert other.engine._value.tolist() == one.engine._value.tolist() == [1, 1]
    assert other.engine._lock is not one.engine._lock


def test_generators_in_place():
    def make():
        rng = np.random.default_rng(3)
        return Node(rng=rng, draw=rng.normal, bits=rng.bit_generator)

    one, other = continued(lambda one: one.rng.spawn(2), make)
    assert other.draw() == one.draw()
    assert other.rng.normal() == one.rng.normal()
    assert other.rng.spawn(1)[0].normal() == one.rng.spawn(1)[0].normal()
    assert other.bits is other.rng.bit_generator


def test_what_a_function_remembers():
    def make():
        count = 0

        def counted():
            nonlocal count
            count += 1
            return count

        return Node(counted=counted)

    _, other = continued(lambda one: [one.counted() for _ in range(3)], make)
    assert other.counted() == 4


class Mixed(dict):
    def __init__(self, **items):
        super().__init__(items)
        self.more = 1


class Ends:
    def __del__(self):
        pass


def local():
    class Local:
        pass

    return Local()


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("engine._lock", lambda: Node(_lock=threading.Lock())),
        ("made[1]", lambda: [1, (each for each in [2])]),
        ("step", lambda: lambda: None),
        ("engine", Engine),
        ("names", lambda: np.array([None])),
        ("made", lambda: [].append),
        ("nothing", object),
        ("mixed", lambda: Mixed(a=1)),
        ("local", local),
        ("ends", Ends),
        ("counts", lambda: defaultdict(int)),
    ],
)
def test_what_cannot_be_captured_is_named(attribute, value):
    one = Node()
    baseline = Baseline(one)
    setattr(one, attribute.split(".")[0].split("[")[0], value())
    with pytest.raises(StateError, match=rf"^Node\.{attribute.replace('[', '.')[:6]}") as caught:
        baseline.capture()
    assert caught.value.path == f"Node.{attribute}"
    assert caught.value.kind.split(".")[-1] in str(caught.value)


def test_dtypes_that_are_computed_later_are_captured():
    def change(one):
        one.kinds = [np.dtype("f4"), np.dtype([("a", "<f8"), ("b", "i4", 2)])]

    one, other = continued(change)
    assert other.kinds == one.kinds


def test_new_views_stay_views():
    def change(one):
        one.part, one.field = one.grid[1:, ::-2], one.records["b"]
        one.turned = np.arange(6.0).reshape(2, 3).T[1:]
        one.part += 1

    records = np.dtype([("a", "f8"), ("b", "i4", 2)])
    make = lambda: Node(grid=np.zeros((3, 4)), records=np.zeros(2, records))  # noqa: E731
    one, other = continued(change, make)
    same(one, other, {})
    other.part += 1
    assert (other.grid[1:, ::-2] == 2).all()
    other.field[:] = 3
    assert other.records["b"].tolist() == [[3, 3], [3, 3]]


def test_objects_of_other_classes():
    def change(one):
        one.space, one.count, one.order = SimpleNamespace(x=1), Counter("aab"), OrderedDict(a=1)
        one.order["b"] = 2

    one, other = continued(change)
    assert (other.space, other.count, other.order) == (one.space, one.count, one.order)
    assert type(other.count) is Counter


def test_damaged_states_are_errors():
    for added in (
        ["object", "test_states:Node", {}],
        ["bits", ["os", None], []],
        ["tuple", None, 3],
    ):
        state = Baseline(Node(x=None)).capture()
        state["changed"], state["added"] = [[0, {"x": (2,)}]], [added]
        with pytest.raises(StateError):
            Baseline(Node(x=None)).restore(state)


def test_methods_of_what_is_captured():
    class Machine:
        def __init__(self):
            self.phase = self.swing

        def swing(self):
            return "swing"

        def stand(self):
            return "stand"

    _, other = continued(lambda one: setattr(one, "phase", one.stand), Machine)
    assert other.phase() == "stand"
    assert other.phase.__self__ is other


def test_constants_are_left_out():
    def make():
        return Node(lock=threading.Lock(), x=1)

    with pytest.raises(StateError, match=r'Node.lock .*constants = \("lock",\)'):
        Baseline(make())
    _, other = continued(lambda one: setattr(one, "x", 2), make, left_out=["lock"])
    assert other.x == 2
    assert hasattr(other, "lock")


def test_only_what_changed_is_kept():
    one = Node(mesh=np.zeros(100000), x=np.zeros(2), zero=0.0, flag=1)
    baseline = Baseline(one)
    one.x[0] = 1
    assert len(encode(baseline.capture(), "state")) < 1000
    assert [number for number, _ in baseline.capture()["changed"]] == [2]
    one.zero, one.flag = -0.0, True
    other = Node(mesh=np.zeros(100000), x=np.zeros(2), zero=0.0, flag=1)
    restored(baseline, Baseline(other))
    assert (str(other.zero), other.flag) == ("-0.0", True)


def test_objects_created_differently_are_refused():
    state = Baseline(Node(a=1.0, b=[2], path=np.zeros(2))).capture()
    for name, other in (
        ("a", Node(a=1.5, b=[2], path=np.zeros(2))),
        ("b", Node(a=1.0, b=[3], path=np.zeros(2))),
        ("path", Node(a=1.0, b=[2], path=np.array([0, -0.0]))),
        ("c", Node(a=1.0, b=[2], path=np.zeros(2), c=1)),
    ):
        with pytest.raises(StateError, match=rf"attributes differ: {name}"):
            Baseline(other).restore(state)


def test_what_an_immutable_object_has_computed_is_no_part_of_its_state():
    here, there = Node(shape=Triangle((3.0, 4.0))), Node(shape=Triangle((3.0, 4.0)))
    baseline = Baseline(here)
    assert here.shape.area == 6
    other = Baseline(there)  # which has not asked for it
    other.restore(baseline.capture())
    assert there.shape.area == 6
    baseline.restore(other.capture())


def test_a_state_creates_no_class_that_is_not_plain():
    for name in ("os:environ", "nowhere:Class", "test_states:Node.x", "subprocess:Popen"):
        state = Baseline(Node(x=None)).capture()
        state["changed"], state["added"] = [[0, {"x": (1,)}]], [["object", name, {}]]
        with pytest.raises(StateError, match="which is not a class"):
            Baseline(Node(x=None)).restore(state)


def test_scripts_are_known_by_their_files(tmp_path):
    """In clients, their modules have other names than in the process that was started."""
    text = """
from physx_core import Environment
class Whole(Environment):
    def create(self):
        self.part = Part()
"""
    part = "class Part: ...\n"
    found = []
    for folder, content in (("before", text), ("one", text + part), ("other", text + part)):
        file = tmp_path / folder / "script.py"
        file.parent.mkdir()
        file.write_text(content)
        found.append(resolve("environment", f"{file}:Whole"))
    one, other = (kind(seed=1) for kind in found[1:])
    for each in (one, other):
        each.create()
    assert type(one).__module__ != type(other).__module__
    source, target = Baseline(one), Baseline(other)
    one.part, one.more = 3, type(one.part)()
    target.restore(decode(encode(source.capture(), "state")))
    assert other.part == 3
    assert type(other.more).__module__ == type(other).__module__
    assert type(other.more).__name__ == "Part"


def test_a_damaged_name_is_an_error():
    state = Baseline(Node(x=None)).capture()
    state["changed"], state["added"] = [[0, {"x": (1,)}]], [["object", "nowhere.py:Part", {}]]
    with pytest.raises(StateError, match="nowhere.py.Part, which is not a class"):
        Baseline(Node(x=None)).restore(state)
