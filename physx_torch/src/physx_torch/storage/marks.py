"""Marks: numbers that show whether an object that cannot be saved changes."""

from __future__ import annotations

import functools
import io
import random
import sys
import types
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch

_PLAIN = (type(None), bool, int, float, str, complex, bytes, np.generic)
_GROUPS = (list, tuple, set, frozenset, deque)


class UnsavableError(Exception):
    """A value cannot be saved, for the given reason: the end of a sentence."""


def mark_of(value: Any, known: Iterable[int]) -> int:
    """Return a number that changes with the data in an object or function.

    Args:
        value: The object.
        known: Identities of objects to leave out.

    Raises:
        UnsavableError: If an object contains tensors, or anything else that certainly is state.
    """
    mark = 0
    for content in _contents(value, set(known), is_part=False):
        mark = zlib.crc32(content, mark)
    return mark


def has_state(value: Any) -> bool:
    """Return whether an object saves and restores its own state, as torch's do."""
    names = ("state_dict", "load_state_dict")
    return not isinstance(value, type) and all(callable(getattr(value, n, None)) for n in names)


def random_numbers(value: Any) -> Any:
    """Return the state of a generator of random numbers as plain data; None: it is none."""
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, np.random.Generator):
        return _without_arrays(value.bit_generator.state)
    if isinstance(value, random.Random):
        version, words, gauss = value.getstate()
        return [version, list(words), gauss]
    return None


def _without_arrays(state: Any) -> Any:
    if isinstance(state, Mapping):
        return {name: _without_arrays(item) for name, item in state.items()}
    return state.tolist() if isinstance(state, (np.ndarray, np.generic)) else state


def _contents(value: Any, seen: set[int], *, is_part: bool) -> Iterator[bytes]:
    """Yield the data in an object.

    Args:
        value: The object.
        seen: Identities of the objects seen so far.
        is_part: Whether it belongs to an object; otherwise, a function uses it.
    """
    if id(value) in seen or isinstance(value, (type, types.ModuleType)):
        return
    if isinstance(value, _PLAIN):
        yield repr(value).encode()
    elif isinstance(value, np.ndarray):
        yield value.tobytes()
    elif isinstance(value, torch.Tensor) and not is_part:
        yield value.detach().resolve_conj().reshape(-1).view(torch.uint8).cpu().numpy().tobytes()
    elif isinstance(value, (torch.Tensor, torch.Generator)) or has_state(value):
        raise UnsavableError(f"contains a {type(value).__name__} that is found nowhere else")
    elif isinstance(value, Iterator) and not isinstance(value, io.IOBase):
        raise UnsavableError(f"is or contains a {type(value).__name__}, which has a position")
    elif (numbers := random_numbers(value)) is not None:
        yield repr(numbers).encode()
    else:
        seen.add(id(value))
        for item in _used_by(value):
            yield from _contents(item, seen, is_part=is_part)
        for item in _parts_of(value):
            yield from _contents(item, seen, is_part=True)


def _used_by(value: Any) -> Iterator[Any]:
    """Yield what a function uses, and what a container contains."""
    if isinstance(value, Mapping):
        yield from value.keys()
        yield from value.values()
    elif isinstance(value, _GROUPS):
        yield from value
    elif isinstance(value, types.FunctionType):
        for cell in value.__closure__ or ():
            try:
                yield cell.cell_contents
            except ValueError:  # empty
                continue
        yield from (value.__defaults__, value.__kwdefaults__, vars(value))
    elif isinstance(value, types.MethodType):
        yield from (value.__func__, value.__self__)
    elif isinstance(value, functools.partial):
        yield from (value.func, value.args, value.keywords)


def _parts_of(value: Any) -> Iterator[Any]:
    """Yield the attributes of an object, unless it is a part of the run or of Python."""
    known = (Mapping, *_GROUPS, types.FunctionType)
    if isinstance(value, known) or _is_foreign(type(value)):
        return
    yield from getattr(value, "__dict__", {}).values()
    for base in type(value).__mro__:
        slots: str | Iterable[str] = base.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            yield getattr(value, name, None)


def _is_foreign(kind: type[Any]) -> bool:
    if issubclass(kind, types.SimpleNamespace):
        return False
    packages = {base.__module__.partition(".")[0] for base in kind.__mro__}
    return kind.__module__.partition(".")[0] in sys.stdlib_module_names or "physx_core" in packages
