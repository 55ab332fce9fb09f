"""SpaceArrays: values of several worlds in a space, as one array per leaf."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ActionError
from physx_core.typing import Array
from physx_remote.errors import RequestError
from physx_remote.serving.spaces import (
    Space,
    SpaceTree,
    cast_exactly,
    find_invalid,
    invalid_value,
    subscripts,
)


class SpaceArrays(SpaceTree):
    """A space whose leaves are arrays, each with a leading axis of worlds.

    Attributes:
        names: Names of the arrays.
    """

    def __init__(self, space: Space, prefix: str) -> None:
        """Find the leaves.

        Args:
            space: Space of one world's values.
            prefix: Prefix of the arrays' names.
        """
        super().__init__(space)
        self.names = [f"{prefix}{number}" for number in range(len(self.leaves))]
        self._parts = [
            (name, np.dtype(leaf.dtype), tuple(leaf.shape or ()), leaf)
            for name, leaf in zip(self.names, self.leaves, strict=True)
        ]
        self._is_discrete = [isinstance(leaf, spaces.Discrete) for leaf in self.leaves]
        has_axes = self.is_leaf and self._parts[0][2] != ()
        self._rows_are_values = self.is_leaf and (has_axes or self._is_discrete[0])

    def zeros(self, count: int) -> dict[str, Array]:
        """Return arrays of zeros for `count` worlds."""
        return {name: np.zeros((count, *shape), dtype) for name, dtype, shape, _ in self._parts}

    def put(self, arrays: Sequence[Array], row: int, value: Any) -> None:
        """Write one world's value into a row of the arrays, without broadcasting."""
        if self.is_leaf:  # in every step of most environments
            _put(arrays[0], row, value)
            return
        for array, part in zip(arrays, self.split(value), strict=True):
            _put(array, row, part)

    def check(self, arrays: Mapping[str, Any], worlds: Sequence[int]) -> None:
        """Validate received arrays of some worlds."""
        count = len(worlds)
        for (name, dtype, shape, leaf), path in zip(self._parts, self.paths, strict=True):
            array = arrays.get(name)
            if not isinstance(array, np.ndarray):
                raise RequestError(f"The actions lack the array {name} of {self.space}.")
            if array.dtype != dtype or array.shape != (count, *shape):
                raise RequestError(
                    f"The array {name} has type {array.dtype} and shape {array.shape}, not {dtype} "
                    f"and {(count, *shape)}: {count} worlds with actions in {self.space}."
                )
            index = find_invalid(leaf, array)
            if index is not None:
                entry = subscripts((*path, *index[1:]))
                place = f"The action{entry} of world {worlds[index[0]]}"
                raise invalid_value(leaf, place, array[index])

    def fit(self, arrays: Mapping[str, Any], count: int) -> bool:
        """Return whether received arrays are valid for `count` worlds."""
        return all(
            is_array(arrays.get(name), dtype, (count, *shape))
            for name, dtype, shape, _ in self._parts
        )

    def rows(self, arrays: Mapping[str, Array], count: int) -> list[Any]:
        """Return the value of each of `count` worlds, as views of the arrays."""
        if self._rows_are_values:
            return list(arrays[self.names[0]])
        return [self.row(arrays, row) for row in range(count)]

    def batch(self, arrays: Mapping[str, Array]) -> Any:
        """Return the worlds' values as one value of Gymnasium's batched space."""
        if self.is_leaf:
            return arrays[self.names[0]]
        return self.join(arrays[name] for name in self.names)

    def row(self, arrays: Mapping[str, Array], row: int) -> Any:
        """Return one world's value, as views of the arrays."""
        if self.is_leaf:
            array = arrays[self.names[0]]
            return array[row] if self._is_discrete[0] else array[row, ...]
        parts = zip(self.names, self._is_discrete, strict=True)
        return self.join(arrays[n][row] if scalar else arrays[n][row, ...] for n, scalar in parts)

    def stack(self, value: Any, *, one: bool = False) -> dict[str, Array]:
        """Return the arrays of a batch of values, or of one value.

        Args:
            value: Value of Gymnasium's batched space, or of the space itself.
            one: Whether it is the value of a single world.
        """
        arrays = {}
        try:
            parts = zip(self._parts, self.split(value), strict=True)
            for (name, dtype, shape, leaf), part in parts:
                array = cast_exactly(part, dtype)
                arrays[name] = array[None] if one else array
                if arrays[name].shape[1:] != shape:
                    raise ActionError(
                        f"An action has shape {arrays[name].shape[1:]}, but {leaf} has shape "
                        f"{shape}."
                    )
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise ActionError(f"{value!r:.200} is not in {self.space}: {error!r}.") from error
        return arrays


def is_array(value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> bool:
    """Return whether a received value is an array of a type and shape."""
    return type(value) is np.ndarray and value.dtype == dtype and value.shape == shape


def _put(array: Array, row: int, value: Any) -> None:
    if np.shape(value) != array.shape[1:]:
        raise ValueError(f"it has shape {np.shape(value)}, not {array.shape[1:]}")
    array[row] = value
