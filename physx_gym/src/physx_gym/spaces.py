"""Trees of spaces and of their values, and the fields that represent their leaves.

A tree is a `Dict` or `Tuple` space, or the dictionaries, lists and tuples that are its elements;
anything else in it is a leaf. A path is the sequence of keys that leads to a leaf.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_core.errors import ConfigError
from physx_core.typing import Array
from physx_sim.errors import SimulationError

Path = tuple[Any, ...]
Leaf = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary


def leaves(tree: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield the leaves of a tree of spaces or values, in order, with their paths."""
    if isinstance(tree, Mapping):
        for key, each in tree.items():
            yield from leaves(each, (*path, key))
    elif isinstance(tree, (list, tuple, spaces.Tuple)):
        for key, each in enumerate(tree):
            yield from leaves(each, (*path, key))
    else:
        yield path, tree


def map_leaves(function: Callable[[Path, Any], Any], tree: Any, path: Path = ()) -> Any:
    """Return a tree of dictionaries, lists and tuples of the same structure, with new leaves.

    Args:
        function: Takes the path of a leaf and the leaf, and returns the replacement.
        tree: The tree; a `Tuple` space becomes a tuple.
        path: Path of the tree itself.
    """
    if isinstance(tree, Mapping):
        return {key: map_leaves(function, each, (*path, key)) for key, each in tree.items()}
    if isinstance(tree, (list, tuple, spaces.Tuple)):
        kind = list if isinstance(tree, list) else tuple
        return kind([map_leaves(function, each, (*path, i)) for i, each in enumerate(tree)])
    return function(path, tree)


def value_at(tree: Any, path: Iterable[Any]) -> Any:
    """Return the part of a tree at a path."""
    for key in path:
        tree = tree[key]
    return tree


def format_path(path: Path) -> str:
    """Return a path in Python syntax, for example ``["states"][0]``."""
    return "".join(f'["{key}"]' if isinstance(key, str) else f"[{key}]" for key in path)


# Buffers: trees of arrays that are updated in place ---------------------------------------------


def neutral(space: gymnasium.Space[Any]) -> Any:
    """Return a new buffer for elements of a space: zeros, or the nearest valid values."""
    return map_leaves(_neutral, space)


def _neutral(_: Path, space: Any) -> Any:
    if isinstance(space, spaces.Box):
        return np.asarray(np.clip(np.zeros(space.shape, space.dtype), space.low, space.high))
    if isinstance(space, spaces.Discrete):
        return np.full((), space.start, space.dtype)
    if isinstance(space, spaces.MultiDiscrete):
        return np.array(space.start, space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    return None


def copy_tree(tree: Any) -> Any:
    """Return a copy of a tree of arrays."""
    kind = type(tree)
    if kind is dict:
        found = {}
        for key, each in tree.items():
            found[key] = each.copy() if type(each) is np.ndarray else copy_tree(each)
        return found
    if kind in (tuple, list):
        return kind([copy_tree(each) for each in tree])
    return tree.copy() if isinstance(tree, np.ndarray) else tree


def copier(space: gymnasium.Space[Any]) -> Callable[[Any], Any]:
    """Return a function that copies buffers to elements of a space; choices become numbers."""
    has_choices = any(isinstance(leaf, spaces.Discrete) for _, leaf in leaves(space))
    return partial(_copy_element, space) if has_choices else copy_tree


def _copy_element(space: gymnasium.Space[Any], tree: Any) -> Any:
    def copy(path: Path, leaf: Any) -> Any:
        value = value_at(tree, path)
        is_choice = isinstance(leaf, spaces.Discrete) and isinstance(value, np.ndarray)
        return value[()] if is_choice else copy_tree(value)

    return map_leaves(copy, space)


def fill(tree: Any, values: Any) -> Any:
    """Write values into a tree of arrays in place.

    Returns:
        The tree; or the values, if the tree is a leaf that is not an array.

    Raises:
        SimulationError: If the values do not have the form of the tree.
    """
    try:
        if isinstance(tree, np.ndarray):
            tree[...] = values
            return tree
        if isinstance(tree, dict):
            for key in tree:
                tree[key] = fill(tree[key], values[key])
            return tree
        if isinstance(tree, (tuple, list)):
            pairs = zip(tree, values, strict=True)
            return type(tree)(fill(each, value) for each, value in pairs)
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise SimulationError(f"The values do not have the expected form: {error}.") from error
    return values


# Fields -----------------------------------------------------------------------------------------


class SpaceFields:
    """The leaves of a space as fields: arrays of a fixed shape and type.

    A field's name is the prefix and the leaf's path, joined by ``_``.

    Attributes:
        space: The space.
        fields: The fields, in the space's order.
        leaves: The leaves themselves, in the same order.
    """

    def __init__(self, space: gymnasium.Space[Any], prefix: str) -> None:
        """Find the leaves.

        Args:
            space: The space.
            prefix: Prefix of the fields' names.

        Raises:
            ConfigError: If values of the space do not have a fixed shape.
        """
        self.space = space
        self.fields: list[Field] = []
        self.leaves: list[Leaf] = []
        self._places: dict[str, tuple[Path, np.dtype[Any]]] = {}
        for path, leaf in leaves(space):
            if not isinstance(leaf, Leaf):
                raise ConfigError(
                    f"The space{format_path(path)} is {leaf}, whose values do not have a fixed "
                    "shape. Only Box, Discrete, MultiDiscrete and MultiBinary spaces, and Dict and "
                    "Tuple spaces of those, can be stored and sent."
                )
            name = stem = "_".join([prefix, *(re.sub(r"\W", "_", str(key)) for key in path)])
            while name in self._places:
                name = f"{stem}_{len(self._places)}"
            self._places[name] = path, np.dtype(leaf.dtype)
            self.leaves.append(leaf)
            self.fields.append(Field(name, tuple(leaf.shape or ()), np.dtype(leaf.dtype)))
        self._names = {path: name for name, (path, _) in self._places.items()}
        self._only = self._names.get(())  # if the space is itself a leaf

    def arrays(self, value: Any) -> dict[str, Array]:
        """Return an element of the space, or a batch of them, as one array per field."""
        found = {}
        for name, (path, dtype) in self._places.items():
            found[name] = np.asarray(value_at(value, path), dtype)
        return found

    def value(self, arrays: Mapping[str, Any]) -> Any:
        """Return the element of the space represented by arrays of its fields."""

        def take(path: Path, leaf: Any) -> Any:
            array = arrays[self._names[path]]
            return leaf.dtype.type(array) if isinstance(leaf, spaces.Discrete) else array

        return map_leaves(take, self.space)

    def put(self, arrays: Mapping[str, Array], place: int, value: Any) -> None:
        """Write an element of the space to an index of arrays with a leading axis."""
        if self._only is not None:
            arrays[self._only][place] = value
            return
        for name, array in self.arrays(value).items():
            arrays[name][place] = array

    def copy(self, arrays: Mapping[str, Array], place: int) -> Any:
        """Return a copy of the element at an index of arrays with a leading axis."""
        if self._only is not None:
            return arrays[self._only][place].copy()
        return self.value({name: array[place].copy() for name, array in arrays.items()})

    def batch(self, arrays: Mapping[str, Any]) -> Any:
        """Return the batch of elements represented by arrays with a leading axis."""
        if self._only is not None:
            return arrays[self._only]
        return map_leaves(lambda path, _: arrays[self._names[path]], self.space)
