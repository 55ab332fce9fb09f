"""Network: base class of networks that predict fields from fields."""

from __future__ import annotations

import os
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from physx_core.components.group import Group
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    FieldsMismatchError,
    UsageError,
    listed,
    nearest,
)
from physx_core.fields import Field, is_finite
from physx_core.typing import Batch, Tensors

_UNREADABLE = (
    OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, MemoryError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What NumPy raises for a file that is damaged or not an archive of arrays."""
_LONGEST_HEADER = 2**14
_WIDEST = 16


class Network(ABC):
    """Base of all networks; a plugin's base class implements it for one library.

    Tensors have the library's own type. In every dictionary of tensors, the first axis is the
    sample axis. Unless the methods are implemented for a library, tensors are NumPy arrays, and a
    network in NumPy needs only `predict` and `get_parameters`: see `physx_core.toy`.

    Attributes:
        net_fields: Input fields of the network.
        opt_fields: Target fields that the loss compares the prediction with.
        pred_fields: Fields that the network predicts; the i-th has the shape, unit and
            normalization of the i-th of `opt_fields`. There may be more or fewer than targets if
            the optimization has a loss for that; further predictions are not converted.
        parameters_file: Name of the file that `save_parameters` writes into a checkpoint.
        default_optimization: Reference of the optimization used if none is configured; empty: one
            must be configured for training.
        default_transformation: Reference of the transformation used if none is configured.
        export_forms: File formats that the network can be exported in.
        exporter: Function that exports, as ``"package.module:function"``. It is called with the
            path, one of `export_forms`, the network, a function from tensors of `net_fields` to
            tensors of `pred_fields` in physical units, and the fields by name.
    """

    parameters_file: ClassVar[str] = "parameters.npz"
    default_optimization: ClassVar[str] = ""
    default_transformation: ClassVar[str] = "physx/identity"
    export_forms: ClassVar[Sequence[str]] = ()
    exporter: ClassVar[str] = ""

    net_fields: Sequence[str] = ("input",)
    opt_fields: Sequence[str] = ("ground_truth",)
    pred_fields: Sequence[str] = ("prediction",)

    @classmethod  # noqa: B027
    def set_seed(cls, seed: int) -> None:
        """Seed the library's random numbers, from which initial parameters are drawn.

        Args:
            seed: Not negative.
        """

    @classmethod  # noqa: B027
    def check_arguments(cls, arguments: Mapping[str, Any], path: Path) -> None:
        """Check arguments from a checkpoint against its parameters, before a network is created.

        This keeps a small file from causing a network of arbitrary size to be created.

        Args:
            arguments: Keyword arguments of the constructor.
            path: File that `save_parameters` wrote.

        Raises:
            CheckpointError: If the parameters are not those of such a network.
        """

    @classmethod
    def join_group(cls, device: str) -> Group:
        """Join the processes that were started to train this network together.

        Args:
            device: As for `set_device`.

        Raises:
            ConfigError: If there are several, but the network's library does not support this, or
                not on this device.
        """
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise ConfigError(
                f"{cls.__name__} cannot be trained by several processes: run it without torchrun."
            )
        return Group()

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Set the shapes of the fields in `net_fields` and `opt_fields` before the first batch.

        Args:
            fields: The dataset's or checkpoint's fields by name.

        Raises:
            FieldsMismatchError: If a field is missing, or its shape does not fit the network.
        """
        missing = {
            name: f"missing; there are {listed(fields)}.{nearest(name, fields)}"
            for name in (*self.net_fields, *self.opt_fields)
            if name not in fields
        }
        if missing:
            raise FieldsMismatchError(
                f"{type(self).__name__} needs fields that the samples lack. Name its inputs and "
                "targets with net_fields and opt_fields in network_kwargs "
                '(--network.network-kwargs "net_fields=[a,b]" opt_fields=c)',
                missing,
            )

    def reject_free_axes(self, fields: Mapping[str, Field]) -> None:
        """Check that the fields of a network whose samples must have one size have no free axis.

        Args:
            fields: Fields by name, of which `net_fields` and `opt_fields` are checked.

        Raises:
            FieldsMismatchError: If one has a free axis.
        """
        free = {
            name: f'its axis "{fields[name].free_axis}" has another size in each sample'
            for name in (*self.net_fields, *self.opt_fields)
            if fields[name].free_axis
        }
        if free:
            raise FieldsMismatchError(
                f"{type(self).__name__} needs samples of one size; those of meshes are taken by "
                '"torch/graph", and by "torch/padded" for a network of yours',
                free,
            )

    @abstractmethod
    def predict(self, data: Tensors) -> Tensors:
        """Return ``{field: tensor}`` for `pred_fields` from the `net_fields` in `data`.

        After `set_eval` no gradients are recorded.
        """

    def forward(self, *inputs: Any) -> Any:
        """Return the network's output for the tensors of `net_fields`, given in that order.

        A library's base class leaves this to its networks, and calls it in `predict`.

        Raises:
            UsageError: If the network does not implement it.
        """
        raise UsageError(f"{type(self).__name__} does not implement forward().")

    def with_gradients(self, tensors: Tensors) -> Tensors:
        """Return tensors with respect to whose `net_fields` predictions can be differentiated.

        Raises:
            ConfigError: If the network's library cannot.
        """
        raise ConfigError(
            f"{type(self).__name__} cannot be differentiated with respect to its inputs: leave out "
            "differentiates_inputs."
        )

    def join_tensors(self, parts: Sequence[Any], axis: int = 0) -> Any:
        """Return tensors joined along an axis that exists."""
        return np.concatenate(parts, axis=axis)

    def set_train(self) -> None:  # noqa: B027
        """Switch to training mode."""

    def set_eval(self) -> None:  # noqa: B027
        """Switch to evaluation mode: no gradients are recorded."""

    def set_device(self, device: str) -> None:
        """Move to a device; ``"auto"`` is the fastest available one.

        Raises:
            ConfigError: If the device does not exist on this machine.
        """
        if device not in ("auto", "cpu"):
            raise ConfigError(f'{type(self).__name__} computes on "cpu", not on "{device}".')

    def set_data_type(self, data_type: str) -> None:  # noqa: B027
        """Compute in ``"float32"`` or ``"float64"``."""

    @abstractmethod
    def get_parameters(self) -> dict[str, Any]:
        """Return the network's own parameters by name, not copies."""

    def get_gradients(self) -> dict[str, Any]:
        """Return the gradients of the last step by parameter; empty if there are none."""
        return {}

    def nb_parameters(self) -> int:
        """Return the number of real numbers in all parameters."""
        return sum(int(np.size(array)) for array in self._arrays().values())

    def find_not_finite(self) -> str:
        """Return the name of a parameter that contains NaN or infinity; empty if there is none."""
        for name, array in self._arrays().items():
            if not is_finite(array):
                return name
        return ""

    def save_parameters(self, path: Path) -> None:
        """Write the parameters to a file that can be read without running code."""
        arrays: dict[str, Any] = self._arrays()
        with path.open("wb") as file:
            np.savez(file, **arrays)

    def load_parameters(self, path: Path) -> None:
        """Read parameters that `save_parameters` wrote, into those of `get_parameters`.

        Raises:
            CheckpointError: If the file is missing, damaged or of another architecture.
        """
        own = self.get_parameters()
        try:
            with np.load(path, allow_pickle=False) as stored:
                nbytes = sum(item.file_size for item in stored.zip.infolist())
                if nbytes > sum(
                    np.size(array) * _WIDEST + _LONGEST_HEADER for array in own.values()
                ):
                    raise ValueError(f"{nbytes} bytes are too many")
                read = {name: stored[name] for name in stored.files}
        except _UNREADABLE as error:
            raise CheckpointError(f"{path} does not contain parameters: {error}.") from error
        shapes, found = (
            {name: np.shape(array) for name, array in arrays.items()} for arrays in (own, read)
        )
        if shapes != found:
            raise CheckpointError(
                f"{path} contains parameters of the shapes {found}, but {type(self).__name__} has "
                f"{shapes}."
            )
        for name, array in own.items():
            array[...] = read[name]

    def numpy_to_tensor(self, batch: Batch) -> Tensors:
        """Return arrays as tensors of the network's type and device, sharing memory if possible."""
        return dict(batch)

    def tensor_to_numpy(self, tensors: Tensors) -> Batch:
        """Return tensors as NumPy arrays."""
        return dict(tensors)

    def _arrays(self) -> Batch:
        arrays = self.tensor_to_numpy(self.get_parameters())
        return {name: np.asarray(array) for name, array in arrays.items()}
