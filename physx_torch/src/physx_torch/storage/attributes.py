"""State in the attributes of an optimization: found by introspection, saved without code.

An attribute is saved if it is a tensor, an array, a generator of random numbers, an object with
``state_dict`` and ``load_state_dict``, or a list, tuple, set or dictionary of these and of plain
data. Plain data alone are saved if they have changed since the training began, so that options
stay those of the constructor. Results of a batch, tensors with a gradient function, are not saved.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping
from typing import Any, NamedTuple

import numpy as np
import torch

from physx_core.errors import CheckpointError
from physx_core.fields import NUMBERS
from physx_core.typing import Array
from physx_torch.storage.marks import UnsavableError, has_state, mark_of, random_numbers

_PLAIN = (type(None), bool, int, float, str)
_INTERNAL = frozenset(vars(torch.nn.Module()))
_LISTS: Mapping[type[Any], str] = {
    list: "list", tuple: "tuple", set: "set", frozenset: "frozenset", deque: "deque",
}  # fmt: skip
_MAKE: Mapping[str, Callable[..., Any]] = {
    "tuple": tuple, "set": set, "frozenset": frozenset, "list": list, "deque": deque,
}  # fmt: skip
Encoded = dict[str, Any]
_ELSEWHERE: Encoded = {"elsewhere": True}  # saved elsewhere, or constant


class _Slot(NamedTuple):
    """An attribute: ``setattr(owner, name, ...)`` replaces its value."""

    path: str
    owner: Any
    name: str
    value: Any


class Attributes:
    """The state in the attributes of an object.

    Attributes:
        unsavable: Reasons by path why attributes could not be saved, after `begin` or `save`.
    """

    def __init__(
        self,
        owner: object,
        *,
        skipped: Collection[str],
        extra: Collection[str] = (),
        unsaved: Collection[str] = (),
        known: Collection[Any] = (),
    ) -> None:
        """Keep the arguments.

        Args:
            owner: The object.
            skipped: Names of attributes that are saved elsewhere.
            extra: Those of them that are included nevertheless.
            unsaved: Paths of attributes that are declared not to be state, such as ``"history"`` or
                ``"loss.history"``.
            known: Objects that are saved elsewhere, wherever they are found.
        """
        self.unsavable: dict[str, str] = {}
        self._owner, self._unsaved = owner, frozenset(unsaved)
        self._skipped = frozenset(skipped) - frozenset(extra)
        self._known = {id(item): item for item in (owner, *known)}  # kept alive: ids are reused
        # Before the training: plain data, marks of other objects, and where there is more.
        self._plain: dict[str, Encoded] = {}
        self._marks: dict[str, int] = {}
        self._held: set[str] = set()
        self._objects: set[str] | None = None
        self._met: set[str] = set()

    def begin(self) -> None:
        """Remember the attributes before the training."""
        self._objects, self._held, self._marks = None, set(), {}
        found = self._encode_all()
        self._held = {path for path, encoded in found.items() if _holds(encoded)}
        self._plain = {path: found[path] for path in found.keys() - self._held}
        self._objects = self._met

    def save(self) -> dict[str, Encoded]:
        """Return the state by path, for `write_state`."""
        return {
            path: encoded
            for path, encoded in self._encode_all().items()
            if _holds(encoded) or encoded != self._plain.get(path)
        }

    def load(self, saved: Mapping[str, Encoded], device: torch.device) -> None:
        """Restore what `save` returned, in place where objects and tensors exist.

        Args:
            saved: The state by path.
            device: Device of tensors that do not exist yet and were not on the CPU.

        Raises:
            CheckpointError: If it does not fit the attributes.
        """
        now = self._encode_all()
        missing = [path for path, encoded in now.items() if path not in saved and _holds(encoded)]
        if missing:
            raise CheckpointError(
                f"it lacks the state of {', '.join(missing)}: it is from another class, or from a "
                "version of physx that did not save it"
            )
        slots = {slot.path: slot for slot in self._slots()}
        for path, encoded in saved.items():
            owner, name = self._owner, path
            if path in slots:
                _, owner, name, _ = slots[path]
            elif "." in path:
                owner, name = self._find(path)
            value = _decode(getattr(owner, name, None), encoded, path, device)
            if getattr(owner, name, None) is not value:
                if name in self._skipped or callable(getattr(type(owner), name, None)):
                    raise CheckpointError(f'"{path}" is not an attribute that may be replaced')
                setattr(owner, name, value)

    def _find(self, path: str) -> tuple[Any, str]:
        """Return the owner and the name of an attribute that does not exist yet."""
        *parts, name = path.split(".")
        owner = self._owner
        for part in parts:
            owner = getattr(owner, part, None)
        if not isinstance(owner, torch.nn.Module):
            raise CheckpointError(f'there is no "{path}"')
        return owner, name

    def _slots(self) -> Iterator[_Slot]:
        for name, value in list(vars(self._owner).items()):
            if name not in self._skipped and id(value) not in self._known:
                yield _Slot(name, self._owner, name, value)
                if isinstance(value, torch.nn.Module):
                    yield from self._inside(name, value)

    def _inside(self, path: str, module: torch.nn.Module) -> Iterator[_Slot]:
        """Yield the attributes of a module that its ``state_dict`` does not contain."""
        for place, part in module.named_modules():
            if id(part) in self._known:
                continue
            for name, value in list(vars(part).items()):
                if name not in _INTERNAL and id(value) not in self._known:
                    yield _Slot(".".join(filter(None, (path, place, name))), part, name, value)

    def _encode_all(self) -> dict[str, Encoded]:
        found = {}
        self._met, self.unsavable = set(), {}
        for path, _, _, value in self._slots():
            if path in self._unsaved or any(path.startswith(f"{name}.") for name in self._unsaved):
                continue
            if _is_result(value) and path not in self._held:
                continue
            try:
                encoded = self._encode(value, path)
            except UnsavableError as error:
                self.unsavable[path] = str(error)
                continue
            if encoded != _ELSEWHERE:
                found[path] = encoded
        return found

    def _encode(self, value: Any, path: str) -> Encoded:
        if id(value) in self._known:
            return _ELSEWHERE
        if isinstance(value, np.generic):
            value = value.item()
        if type(value) in _PLAIN:
            return {"plain": value}
        if isinstance(value, torch.Tensor):
            kept = value.detach()
            return {"tensor": kept, "device": value.device.type, "learned": value.requires_grad}
        if isinstance(value, np.ndarray) and value.dtype.kind in NUMBERS:
            return {"array": torch.from_numpy(np.array(value, value.dtype.newbyteorder("=")))}
        if (numbers := random_numbers(value)) is not None:
            self._note(path)
            return {"random": numbers}
        if has_state(value):
            self._note(path)
            state = value.state_dict()
            return {"object": state} if state else _ELSEWHERE
        return self._encode_container(value, path)

    def _encode_container(self, value: Any, path: str) -> Encoded:
        if isinstance(value, MutableMapping):
            if type(value) is not dict:
                self._note(path)
            for key in value:
                if type(key) not in _PLAIN:
                    raise UnsavableError(f"has a key that is a {type(key).__name__}")
            items = ((key, self._item(item, f"{path}[{key!r}]")) for key, item in value.items())
            return {"dict": [[key, item] for key, item in items]}
        kind = next((name for base, name in _LISTS.items() if isinstance(value, base)), None)
        if kind is None:
            self._check_mark(value, path)
            return _ELSEWHERE
        if type(value) not in _LISTS or getattr(value, "maxlen", None) is not None:
            self._note(path)
        ordered = sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value
        return {kind: [self._item(item, f"{path}[{i}]") for i, item in enumerate(ordered)]}

    def _item(self, value: Any, path: str) -> Encoded:
        if _is_result(value):
            return {"plain": None}
        encoded = self._encode(value, path)
        if encoded == _ELSEWHERE and id(value) not in self._known:
            self._note(path)
        return encoded

    def _check_mark(self, value: Any, path: str) -> None:
        """Check that an object that cannot be restored does not change in the training."""
        mark = mark_of(value, self._known)
        if self._marks.setdefault(path, mark) != mark:
            raise UnsavableError(f"is a {type(value).__name__} that changes in the training")

    def _note(self, path: str) -> None:
        """Note an object that a resumed training cannot create from its state."""
        self._met.add(path)
        if self._objects is not None and path not in self._objects:
            raise UnsavableError(
                "was created after the training had begun, so that a resumed training does not "
                "have it: create it in set_optimizer()"
            )


def _is_result(value: Any) -> bool:
    """Return whether a value is a result of the current batch."""
    return isinstance(value, torch.Tensor) and value.grad_fn is not None


def _set_random_numbers(value: Any, state: Any) -> None:
    if isinstance(value, torch.Generator):
        value.set_state(state)
    elif isinstance(value, np.random.Generator):
        value.bit_generator.state = state
    elif isinstance(value, random.Random):
        version, words, gauss = state
        value.setstate((version, tuple(words), gauss))
    else:
        raise TypeError("there is no generator of random numbers")


def _holds(encoded: Encoded) -> bool:
    """Return whether more than plain data is in an encoded value."""
    if {"tensor", "array", "random", "object"} & encoded.keys():
        return True
    if "dict" in encoded:
        return any(_holds(item) for _, item in encoded["dict"])
    return any(_holds(item) for name in _MAKE for item in encoded.get(name, ()))


def _decode(current: Any, encoded: Encoded, path: str, device: torch.device) -> Any:
    """Return the value that replaces `current`, which may be the same object, changed in place."""
    if encoded == _ELSEWHERE:
        return current
    (kind, state), *_ = encoded.items()
    try:
        if kind == "tensor":
            return _decode_tensor(current, encoded, device)
        if kind in ("random", "object"):
            return _restore(current, kind, state)
        if kind == "dict":
            return _decode_mapping(current, state, path, device)
        if kind in _MAKE:
            return _decode_list(current, kind, state, path, device)
        return state if kind == "plain" else _decode_array(current, state.numpy())
    except CheckpointError:
        raise
    except Exception as error:  # load_state_dict may raise anything for the state of another object
        raise CheckpointError(f'its "{path}" does not fit: {error}') from error


def _restore(current: Any, kind: str, state: Any) -> Any:
    if kind == "random":
        _set_random_numbers(current, state)
    elif has_state(current):
        current.load_state_dict(state)
    else:
        raise TypeError("there is no such object before the training")
    return current


def _decode_tensor(current: Any, encoded: Encoded, device: torch.device) -> torch.Tensor:
    stored: torch.Tensor = encoded["tensor"]
    if isinstance(current, torch.Tensor) and current.grad_fn is None:
        if (current.shape, current.dtype) == (stored.shape, stored.dtype):
            with torch.no_grad():
                return current.copy_(stored)
        if current.requires_grad:  # an optimizer knows it
            raise ValueError(f"it has shape {tuple(stored.shape)}, not {tuple(current.shape)}")
    made = stored if encoded["device"] == "cpu" else stored.to(device)
    return made.requires_grad_(encoded["learned"])


def _decode_array(current: Any, stored: Array) -> Array:
    alike = isinstance(current, np.ndarray) and current.flags.writeable
    if not alike or (current.shape, current.dtype) != (stored.shape, stored.dtype):
        return stored
    current[...] = stored
    return current


def _decode_mapping(current: Any, items: Any, path: str, device: torch.device) -> Any:
    own = current if isinstance(current, MutableMapping) else {}
    new = {key: _decode(own.get(key), item, f"{path}[{key!r}]", device) for key, item in items}
    own.clear()
    own.update(new)
    return own


def _decode_list(current: Any, kind: str, items: Any, path: str, device: torch.device) -> Any:
    own = list(current) if isinstance(current, (list, tuple)) else []
    own += [None] * (len(items) - len(own))
    pairs = enumerate(zip(own, items, strict=False))
    new = [_decode(old, item, f"{path}[{i}]", device) for i, (old, item) in pairs]
    if isinstance(current, (list, deque)):
        current.clear()
        current.extend(new)
        return current
    if isinstance(current, tuple) and hasattr(current, "_make"):
        return current._make(new)
    return _MAKE[kind](new)
