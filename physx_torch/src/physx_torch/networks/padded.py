"""PaddedNetwork: values of any size as samples of one size, with a mask, for a plain module."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch

from physx_core import Field
from physx_core.errors import ConfigError, FieldShapeError, FieldsMismatchError, listed, nearest
from physx_core.fields import PTR
from physx_torch.networks.module_network import ModuleNetwork


class _Places(NamedTuple):
    """Where the entries of an axis are in samples of one size.

    Attributes:
        starts: The first entry of each sample, shape (samples,).
        sample: The sample of each entry, shape (entries,).
        place: Its number there.
        size: Number of entries of a padded sample.
    """

    starts: torch.Tensor
    sample: torch.Tensor
    place: torch.Tensor
    size: int


class PaddedNetwork(ModuleNetwork):
    """A plain module for samples of one size: entries of free axes are padded with zeros.

    Its ``forward`` takes the tensors of `net_fields` in order, of a field with a free axis of shape
    (samples, size, *shape of an entry), and after them a mask for each free axis, in the order in
    which the fields have them, of shape (samples, size): true where there is an entry. Numbers of
    `Field.indexes` are counted from 0 in each sample, and 0 in the padding. Predictions of fields
    with a free axis have shape (samples, size, *shape of an entry). Their padding is left out
    before anything is made of them, so that losses, errors and statistics are those of entries.

    Attributes:
        sizes: Number of entries of each sample, by free axis.
    """

    def __init__(
        self,
        module: str | Callable[..., torch.nn.Module],
        *,
        sizes: Mapping[str, int] | None = None,
        **arguments: Any,
    ) -> None:
        """Create the module.

        Args:
            module: As in `ModuleNetwork`.
            sizes: Number of entries of each sample, by free axis; of others, as many as the largest
                sample of a batch has.
            arguments: As in `ModuleNetwork`.

        Raises:
            ConfigError: As in `ModuleNetwork`, or if a size is not positive.
        """
        super().__init__(module, **arguments)
        self.sizes = dict(sizes or {})
        for axis, size in self.sizes.items():
            if type(size) is not int or size < 1:
                raise ConfigError(
                    f"PaddedNetwork.sizes is {size!r} for {axis} but must be positive."
                )
        self._given = self.net_fields
        self._fields: list[Field] = []
        self._axes: list[str] = []
        self._predicted: list[str] = []

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Find out which fields have free axes.

        Raises:
            FieldsMismatchError: If none has, or no input has an axis that a field indexes or that a
                target has.
            ConfigError: If `sizes` names another axis.
        """
        self.net_fields = self._given
        super().bind(fields)
        self._fields = [fields[name] for name in self._given]
        self._axes = list(dict.fromkeys(f.free_axis for f in self._fields if f.free_axis))
        targets = [fields[name] for name in self.opt_fields]
        used = {f.name: f.free_axis for f in targets} | {f.name: f.indexes for f in self._fields}
        missing = {
            name: f'no input has the axis "{axis}"'
            for name, axis in used.items()
            if axis and axis not in self._axes
        }
        if missing or not self._axes:
            none = dict.fromkeys(self._given, "without a free axis")
            raise FieldsMismatchError("PaddedNetwork pads free axes", missing or none)
        for axis in self.sizes.keys() - set(self._axes):
            raise ConfigError(
                f'PaddedNetwork.sizes names the axis "{axis}", but the inputs have '
                f"{listed(self._axes)}.{nearest(axis, self._axes)}"
            )
        self._predicted = [field.free_axis for field in targets]
        self.net_fields = (*self._given, *(axis + PTR for axis in self._axes))

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return the module's predictions, those of entries end to end.

        Args:
            inputs: The tensors of `net_fields`, packed, and where the samples of each axis begin.

        Raises:
            FieldShapeError: If a sample has more entries than `sizes` gives it.
        """
        values, ends = inputs[: len(self._fields)], inputs[len(self._fields) :]
        places = {axis: self._places(axis, ptr) for axis, ptr in zip(self._axes, ends, strict=True)}
        padded = [
            self._pad(tensor, field, places)
            for tensor, field in zip(values, self._fields, strict=True)
        ]
        masks = [_fill(torch.ones_like(at.sample, dtype=torch.bool), at) for at in places.values()]
        found = self._by_field(self.module(*padded, *masks))
        for name, axis in zip(self.pred_fields, self._predicted, strict=False):
            if axis:
                at = places[axis]
                found[name] = found[name][at.sample, at.place]
        return found

    def _places(self, axis: str, ptr: torch.Tensor) -> _Places:
        counts = ptr.diff()
        most = int(counts.max()) if len(counts) else 0
        size = self.sizes.get(axis, most)
        if most > size:
            raise FieldShapeError(
                f'A sample has {most} entries on the axis "{axis}", but PaddedNetwork.sizes gives '
                f"it {size}: raise that."
            )
        sample = torch.repeat_interleave(counts)
        place = torch.arange(len(sample), device=ptr.device) - ptr[:-1][sample]
        return _Places(ptr[:-1], sample, place, size)

    def _pad(
        self, tensor: torch.Tensor, field: Field, places: Mapping[str, _Places]
    ) -> torch.Tensor:
        at = places.get(field.free_axis)
        if field.indexes:
            starts = places[field.indexes].starts
            shift = starts if at is None else starts[at.sample]
            tensor = tensor - shift.reshape(-1, *(1,) * (tensor.ndim - 1))
        return tensor if at is None else _fill(tensor, at)


def _fill(values: torch.Tensor, at: _Places) -> torch.Tensor:
    """Return entries in samples of one size."""
    found = values.new_zeros(len(at.starts), at.size, *values.shape[1:])
    found[at.sample, at.place] = values
    return found
