"""The attributes that subclasses add to an environment, as snapshots take them along.

They are copied as by `copy.deepcopy`, aliases included, but for what the environment has anyway: a
view of the robot's state stays one. Restoring writes into the objects that are there, as others
(recorded variables, rewards) may hold them.
"""

from __future__ import annotations

import copy
import functools
import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from types import MethodType
from typing import Any

import numpy as np

from physx_gym.shared_arrays import SharedArrays, Window, whole_of, window_of
from physx_sim.errors import SimulationError

_KNOWN = "known"
_FORMS = ("__reduce__", "__reduce_ex__", "__deepcopy__", "__getstate__", "__setstate__")
_ATOMS = (type(None), bool, int, float, complex, str, bytes, np.generic, type)


def take(env: Any, layers: Sequence[Any], simulator: Any) -> dict[str, Any]:
    """Return copies of the attributes that subclasses have added to an environment.

    Args:
        env: The environment, or a layer of it.
        layers: All layers of its pipeline.
        simulator: The pipeline's simulator.

    Raises:
        SimulationError: If one cannot be copied.
    """
    names = _own_names(env)
    if not names:
        return {}
    memo: dict[int, Any] = {
        id(each): _Known(name) for name, each in _known(layers, simulator).items()
    }
    found = {}
    for name in names:
        value = vars(env)[name]
        try:
            _replace(value, memo)
            found[name] = copy.deepcopy(value, memo)
        except Exception as error:
            raise SimulationError(
                f"A snapshot cannot take {type(env).__name__}.{name} along, a "
                f"{type(value).__name__}: {error}. If it never changes, or _memory and _recall "
                f'take care of it, name it in the class: constants = ("{name}",).'
            ) from error
    return found


def put_back(env: Any, layers: Sequence[Any], simulator: Any, taken: dict[str, Any]) -> None:
    """Restore what `take` returned, and remove attributes added since.

    Args:
        env: As in `take`.
        layers: As in `take`.
        simulator: As in `take`.
        taken: What `take` returned.
    """
    names = _own_names(env)
    if not names and not taken:
        return
    known, own = _known(layers, simulator), vars(env)
    memo: dict[Any, Any] = {_KNOWN: known}
    copies = copy.deepcopy(taken, memo)
    settle = _Settling(known)
    for name in names:
        if name not in copies:
            del own[name]
    for name, value in copies.items():
        own[name] = settle(own.get(name), value)


def _own_names(env: Any) -> list[str]:
    kind: Any = type(env)
    constants = _constants_of(kind)
    return [name for name in vars(env) if name not in constants]


@functools.cache
def _constants_of(kind: type[Any]) -> frozenset[str]:
    return frozenset(name for each in kind.__mro__ for name in vars(each).get("constants", ()))


# What the environment has anyway ----------------------------------------------------------------


class _Known:
    """In a snapshot, stands for an object that every environment of the kind has, or its method."""

    def __init__(self, name: str, method: str | None = None) -> None:
        self.name, self.method = name, method

    def __deepcopy__(self, memo: dict[Any, Any]) -> Any:
        if _KNOWN not in memo:
            return self
        found = memo[_KNOWN][self.name]
        return found if self.method is None else getattr(found, self.method)


def _known(layers: Sequence[Any], simulator: Any) -> dict[str, Any]:
    """Return the objects of an environment's pipeline and simulator, by name."""
    found: dict[str, Any] = {}
    seen: set[int] = set()
    for number, layer in enumerate(layers):
        found[f"{number}"] = layer
        seen.add(id(layer))
        kind: Any = type(layer)
        for name in sorted(_constants_of(kind)):
            _collect(f"{number}.{name}", vars(layer).get(name), found, seen)
    for name, value in vars(simulator).items():
        _collect(f"simulator.{name}", value, found, seen)
    return found


def _collect(name: str, value: Any, found: dict[str, Any], seen: set[int]) -> None:
    """Add an object, and those in it, to the known ones; each has one name."""
    if isinstance(value, _ATOMS) or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        _collect(f"{name}.whole", whole_of(value), found, seen)
    elif isinstance(value, (tuple, list)):
        for number, each in enumerate(value):
            _collect(f"{name}.{number}", each, found, seen)
    elif isinstance(value, (dict, SharedArrays)):
        parts = value if isinstance(value, dict) else vars(value)
        for key, each in parts.items():
            _collect(f"{name}.{key}", each, found, seen)
    if not isinstance(value, tuple):
        found[name] = value


# Copies -----------------------------------------------------------------------------------------


def _replace(value: Any, memo: dict[int, Any]) -> None:
    """Have windows in place of the views in a value, and names in place of methods of the known."""
    for array in _leaves(value, memo, set()):
        if isinstance(array, MethodType):
            owner = memo.get(id(array.__self__))
            if isinstance(owner, _Known):
                memo[id(array)] = _Known(owner.name, array.__name__)
            continue
        if (window := window_of(array)) is not None:
            window.whole = copy.deepcopy(window.whole, memo)
            memo[id(array)] = window


def _leaves(
    value: Any, memo: dict[int, Any], seen: set[int]
) -> Iterator[np.ndarray[Any, Any] | MethodType]:
    """Yield the arrays and methods in a value that is not known yet."""
    if isinstance(value, _ATOMS) or id(value) in memo or id(value) in seen:
        return
    seen.add(id(value))
    if type(value) in (np.ndarray, MethodType):
        yield value
    for part in _parts(value):
        yield from _leaves(part, memo, seen)


def _parts(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    if isinstance(value, (list, tuple, deque)):
        return list(value)
    return list(vars(value).values()) if _is_plain(value) else []


def _is_plain(value: Any) -> bool:
    """Return whether an object is nothing but its attributes, which may change."""
    kind = type(value)
    if kind.__module__ == "builtins" or callable(value) or not hasattr(value, "__dict__"):
        return False
    own = {name for each in kind.__mro__[:-1] for name in vars(each)}
    is_frozen = getattr(getattr(kind, "__dataclass_params__", None), "frozen", False)
    return not is_frozen and own.isdisjoint(_FORMS)


class _Settling:
    """Writes restored values into the objects that are there, each of which is used once."""

    def __init__(self, known: dict[str, Any]) -> None:
        self._known = {id(each) for each in known.values()}
        self._settled: dict[int, Any] = {}
        self._used: dict[int, Any] = {}
        self._values: list[Any] = []  # alive, as their ids are keys

    def __call__(self, current: Any, value: Any) -> Any:
        """Return the object that takes the place of a restored value.

        Args:
            current: The object that is there now; None: there is none.
            value: The restored value.
        """
        if isinstance(value, _ATOMS) or id(value) in self._known:
            return value
        if id(value) not in self._settled:
            self._values.append(value)
            if isinstance(value, Window):
                self._settled[id(value)] = self._opened(current, value)
            elif isinstance(value, tuple):
                self._settled[id(value)] = self._tuple(current, value)
            else:
                fits = self._fits(current, value)
                place = current if fits else value
                self._settled[id(value)] = self._used[id(place)] = place
                self._fill(current if fits else None, value, place)
        return self._settled[id(value)]

    def _fits(self, current: Any, value: Any) -> bool:
        """Return whether an object may be overwritten with a value."""
        is_taken = id(current) in self._known or id(current) in self._used
        if is_taken or type(current) is not type(value):
            return False
        if type(value) is np.ndarray:
            is_own = current.base is None
            return bool(is_own and current.shape == value.shape and current.dtype == value.dtype)
        if isinstance(value, np.random.Generator):
            return type(current.bit_generator) is type(value.bit_generator)
        if isinstance(value, deque):
            return bool(current.maxlen == value.maxlen)
        return isinstance(value, (dict, list, set)) or _is_plain(value)

    def _fill(self, current: Any, value: Any, place: Any) -> None:
        """Write a value into its place, which is the value itself if nothing was there."""
        if type(value) is np.ndarray:
            place[...] = value
        elif isinstance(value, np.random.Generator):
            place.bit_generator.state = value.bit_generator.state
        elif isinstance(value, set):
            items = set(value)
            place.clear()
            place.update(items)
        elif isinstance(value, (list, deque)):
            before = [] if current is None else list(current)
            pairs = itertools.zip_longest(before[: len(value)], list(value))
            items_now = [self(*pair) for pair in pairs]
            place.clear()
            place.extend(items_now)
        elif isinstance(value, dict) or _is_plain(value):
            own, new = (x if isinstance(x, dict) else vars(x) for x in (place, value))
            now = {key: self(own.get(key) if current is not None else None, each)
                   for key, each in new.items()}  # fmt: skip
            own.clear()
            own.update(now)

    def _tuple(self, current: Any, value: tuple[Any, ...]) -> Any:
        fits = type(current) is type(value) and len(current) == len(value)
        before = current if fits else [None] * len(value)
        parts = [self(*pair) for pair in zip(before, value, strict=True)]
        if all(new is old for new, old in zip(parts, value, strict=True)):
            return value
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)

    def _opened(self, current: Any, window: Window) -> Any:
        is_array = type(current) is np.ndarray
        window.whole = self(whole_of(current) if is_array else None, window.whole)
        found = window.open()
        same = ("shape", "strides", "dtype", "__array_interface__")
        if is_array and all(getattr(current, name) == getattr(found, name) for name in same):
            return current
        return found
