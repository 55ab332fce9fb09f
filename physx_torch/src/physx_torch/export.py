"""Exports a network with its transformation to one file that runs without physx."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from physx_core import Field
from physx_core.errors import ConfigError, MissingLibraryError
from physx_torch.networks.network import TorchNetwork

Tensors = dict[str, torch.Tensor]
Predict = Callable[[Tensors], Tensors]


class _PhysicalUnits(torch.nn.Module):
    """A network with its transformation as one module, from physical units to physical units.

    Attributes:
        network: The network.
        inputs: Names of the input fields.
        outputs: Names of the output fields; one that is also an input is ``predicted_<name>``.
    """

    def __init__(self, network: TorchNetwork, predict: Predict) -> None:
        super().__init__()
        self.network = network
        self.inputs = list(network.net_fields)
        self.outputs = [
            f"predicted_{name}" if name in self.inputs else name for name in network.pred_fields
        ]
        self._predict = predict

    def forward(self, data: Tensors) -> Tensors:
        """Return the predictions by output name for tensors by input name."""
        prediction = self._predict(data)
        names = zip(self.outputs, self.network.pred_fields, strict=True)
        return {output: prediction[name] for output, name in names}


def export_network(
    path: Path,
    form: str,
    network: TorchNetwork,
    predict: Predict,
    fields: Mapping[str, Field],
) -> None:
    """Write a network and its transformation as ``"onnx"``, ``"torchscript"`` or ``"pt2"``.

    The first axis of inputs and outputs is the sample axis, of any length. Floating-point inputs
    have the network's data type. ONNX inputs and outputs are named after the fields; the other two
    formats take and return a dictionary of tensors by field. A field that is both an input and
    predicted is output as ``predicted_<name>``.

    Args:
        path: The file; an existing one is replaced.
        form: The file's format.
        network: The network, on the CPU.
        predict: Prediction in physical units with the network: tensors by field to tensors by
            field.
        fields: The fields that the network was bound to, by name.
    """
    if network.device.type != "cpu":
        raise ConfigError(
            f'A network must be on the CPU to be exported, not on "{network.device}", so that the '
            'file runs anywhere: load it with device="cpu", as physx export-network does.'
        )
    samples = {name: _samples(fields[name], network) for name in network.net_fields}
    try:
        with _evaluating(network), _quiet():
            predict(samples)  # finds out whether the network differentiates
            if network.differentiates:
                predict = _record_derivatives(predict, samples, network, form)
            FORMS[form](_PhysicalUnits(network, predict).eval(), samples, path)
    except MissingLibraryError:
        raise
    except Exception as error:  # an exporter may fail in any way
        name = type(network).__name__
        raise ConfigError(f'{name} cannot be exported as "{form}": {_reason(error)}') from error


def _reason(error: BaseException) -> str:
    """Return the first line of the error that started a chain of errors."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


@contextlib.contextmanager
def _evaluating(network: TorchNetwork) -> Iterator[None]:
    """Put a network temporarily into evaluation mode, with parameters that need no gradients."""
    was_training = network.training
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    network.set_eval()
    network.requires_grad_(False)
    try:
        with torch.no_grad():
            yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)
        network.train(was_training)


def _record_derivatives(
    predict: Predict, samples: Tensors, network: TorchNetwork, form: str
) -> Predict:
    """Return the plain operations of a prediction that differentiates.

    Exporters record operations, but not that torch differentiates them.
    """
    if form == "torchscript":
        raise ConfigError("TorchScript does not record derivatives; onnx and pt2 do.")
    tensors = (*samples.values(), *network.parameters(), *network.buffers())
    taken = {size for tensor in tensors for size in tensor.shape}
    # Axes of equal sizes would be taken for one: the sample axis gets a size of its own.
    rows = next(count for count in itertools.count(3) if count not in taken)
    record = make_fx(  # which does not take methods
        lambda data: predict(data), tracing_mode="symbolic", _allow_non_fake_inputs=True
    )
    recorded: Any = record(
        {name: values[:1].expand(rows, *values.shape[1:]) for name, values in samples.items()}
    )
    found = recorded(samples)
    for name, wanted in predict(samples).items():
        if torch.allclose(found[name], wanted, equal_nan=True):
            continue
        raise ConfigError("its derivatives depend on the number of samples.")
    return cast("Predict", recorded)


def _samples(field: Field, network: TorchNetwork) -> torch.Tensor:
    """Return example samples of a field with which the exporters trace the network."""
    zeros = np.zeros((2, *(field.shape or ())), field.dtype)
    return network.numpy_to_tensor({field.name: zeros})[field.name]


def _torchscript(module: _PhysicalUnits, samples: Tensors, path: Path) -> None:
    traced = torch.jit.trace(module, (samples,), strict=False, check_trace=False)
    buffer = io.BytesIO()
    torch.jit.save(traced, buffer)
    _replace(path, lambda partial: partial.write_bytes(buffer.getvalue()))


def _axes(samples: Tensors) -> dict[str, Any]:
    """Mark the sample axis as one of any length, in the form that the exporters expect."""
    axis = torch.export.Dim("samples")
    return {"data": {name: {0: axis} for name in samples}}


def _pt2(module: _PhysicalUnits, samples: Tensors, path: Path) -> None:
    program = torch.export.export(module, (samples,), dynamic_shapes=_axes(samples))
    _replace(path, lambda partial: torch.export.save(program, partial), ".pt2")


def _onnx(module: _PhysicalUnits, samples: Tensors, path: Path) -> None:
    for library in ("onnx", "onnxscript"):
        try:
            __import__(library)
        except ImportError as error:
            raise MissingLibraryError(
                "Exporting to ONNX", library, "export", "physx-torch"
            ) from error
    written = torch.onnx.export(
        module,
        kwargs={"data": samples},
        dynamic_shapes=_axes(samples),
        input_names=module.inputs,
        output_names=module.outputs,
        dynamo=True,
        verbose=False,
    )
    if written is None:
        raise ConfigError("the exporter returned no program.")
    _replace(path, lambda partial: written.save(partial, external_data=False))


def _replace(path: Path, write_to: Callable[[Path], Any], suffix: str = ".partial") -> None:
    """Write a file that appears under its name only when it is complete."""
    partial = path.with_name(f".{path.name}.partial").with_suffix(suffix)
    try:
        write_to(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporters' warnings and logs about their internals."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


FORMS: dict[str, Callable[[_PhysicalUnits, Tensors, Path], None]] = {
    "onnx": _onnx,
    "torchscript": _torchscript,
    "pt2": _pt2,
}
"""Writer of each file format."""
