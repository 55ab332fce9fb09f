"""The values of a Gymnasium space as arrays of fixed shapes, and back."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_core.errors import ConfigError
from physx_core.typing import Array

Path = tuple[Any, ...]
Leaf = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary


class SpaceFields:
    """The leaves of a space: each is a field, an array of one shape and type.

    Boxes, `Discrete`, `MultiDiscrete` and `MultiBinary` are leaves; dictionaries and tuples hold
    others. A leaf's name is the prefix and its path, joined by ``_``.

    Attributes:
        space: The space.
        fields: The leaves as fields, in the space's order.
    """

    def __init__(self, space: gymnasium.Space[Any], prefix: str) -> None:
        """Find the leaves.

        Args:
            space: The space.
            prefix: What their names begin with.

        Raises:
            ConfigError: The space holds values without a fixed shape.
        """
        self.space = space
        self.fields: list[Field] = []
        self._leaves: list[tuple[str, Path, Leaf]] = []
        names: set[str] = set()
        for path, leaf in _leaves(space, ()):
            plain = [re.sub(r"\W", "_", str(key)) for key in path]
            name = stem = "_".join([prefix, *plain])
            while name in names:
                name = f"{stem}_{len(names)}"
            names.add(name)
            self._leaves.append((name, path, leaf))
            self.fields.append(Field(name, tuple(leaf.shape or ()), _dtype(leaf)))

    @property
    def leaves(self) -> list[Leaf]:
        """The space's leaves, in the order of the fields."""
        return [leaf for _, _, leaf in self._leaves]

    def arrays(self, value: Any) -> dict[str, Array]:
        """Return a value of the space, or of a batch of it, as an array for each field."""
        found = {}
        for name, path, leaf in self._leaves:
            part = value
            for key in path:
                part = part[key]
            found[name] = np.asarray(part, _dtype(leaf))
        return found

    def value(self, arrays: Mapping[str, Any]) -> Any:
        """Return the value of the space that arrays stand for; leaves are the arrays themselves."""
        return self._built({path: arrays[name] for name, path, _ in self._leaves}, scalars=True)

    def batch(self, arrays: Mapping[str, Any]) -> Any:
        """Return the value of a batch of the space, from arrays with a leading axis."""
        return self._built({path: arrays[name] for name, path, _ in self._leaves}, scalars=False)

    def _built(self, leaves: Mapping[Path, Any], *, scalars: bool) -> Any:
        def build(space: gymnasium.Space[Any], path: Path) -> Any:
            if isinstance(space, spaces.Dict):
                return {key: build(part, (*path, key)) for key, part in space.spaces.items()}
            if isinstance(space, spaces.Tuple):
                return tuple(build(part, (*path, i)) for i, part in enumerate(space.spaces))
            if scalars and isinstance(space, spaces.Discrete):
                return space.dtype.type(leaves[path])
            return leaves[path]

        return build(self.space, ())


def _dtype(leaf: Leaf) -> np.dtype[Any]:
    return np.dtype(leaf.dtype)


def _leaves(space: gymnasium.Space[Any], path: Path) -> Iterator[tuple[Path, Leaf]]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from _leaves(part, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for place, part in enumerate(space.spaces):
            yield from _leaves(part, (*path, place))
    elif isinstance(space, Leaf):
        yield path, space
    else:
        where = "".join(f"[{key!r}]" for key in path)
        raise ConfigError(
            f"The space{where} is {space}, whose values have no fixed shape. Box, Discrete, "
            "MultiDiscrete and MultiBinary spaces can be stored and sent, and Dict and Tuple "
            "spaces of those."
        )
