"""PredictedBatch: a batch and what the network predicts from it, as a loss gets them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from physx_core.components.network import Network
from physx_core.components.transformation import Transformation
from physx_core.typing import Tensors


@dataclass(slots=True, eq=False)
class PredictedBatch:
    """A batch and what the network predicts from it, normalized and in physical units.

    A loss compares `prediction` with `targets`, which are normalized if the training normalizes.
    Laws of physics hold in physical units: for `data`, `physical_prediction` and
    `physical_targets`. In training, predictions can be differentiated with respect to the network's
    parameters. `predict` can also be differentiated with respect to its inputs, in a validation
    too; with PyTorch, for a network that reads a time in s and predicts a position in m::

        time = batch.data["time"].detach().requires_grad_()
        position = batch.predict({**batch.data, "time": time})["position"]
        (speed,) = torch.autograd.grad(position.sum(), time, create_graph=True)  # in m/s

    Attributes:
        network: The network.
        transformation: Converts between physical units and what the network computes with.
        data: All fields of the batch in physical units.
        inputs: The network's `net_fields` as it gets them.
        output: The network's `pred_fields` as it returns them.
        prediction: The network's `pred_fields` as the loss compares them.
        targets: The network's `opt_fields` as the loss compares them; of increments, the changes.
    """

    network: Network
    transformation: Transformation
    data: Tensors
    inputs: Tensors
    output: Tensors
    prediction: Tensors
    targets: Tensors

    @classmethod
    def of(cls, network: Network, transformation: Transformation, data: Tensors) -> PredictedBatch:
        """Predict a batch.

        Args:
            network: The network.
            transformation: The network's transformation.
            data: The batch in physical units, with at least `net_fields` and `opt_fields`.
        """
        read, targets = pick(data, network.net_fields), pick(data, network.opt_fields)
        inputs = transformation.transform_before_prediction(read)
        output = network.predict(inputs)
        if transformation.increments:
            targets = transformation.increments.of(targets, read)
        compared = transformation.transform_before_loss(output, targets)
        return cls(network, transformation, data, inputs, output, *compared)

    @classmethod
    def joined(cls, parts: Sequence[PredictedBatch]) -> PredictedBatch:
        """Return the rows of several batches of the same fields as one."""
        first, names = parts[0], ("data", "inputs", "output", "prediction", "targets")
        if len(parts) == 1:
            return first
        join = first.network.join_tensors
        rows = (
            {
                key: join([getattr(part, name)[key] for part in parts])
                for key in getattr(first, name)
            }
            for name in names
        )
        return cls(first.network, first.transformation, *rows)

    @property
    def physical_prediction(self) -> Tensors:
        """The network's `pred_fields` in physical units; computed anew each time."""
        return _to_physical(self.transformation, self.output, self.data)

    @property
    def physical_targets(self) -> Tensors:
        """The network's `opt_fields` in physical units."""
        return pick(self.data, self.network.opt_fields)

    def predict(self, data: Tensors) -> Tensors:
        """Return what the network predicts from other values, both in physical units.

        Where tensors of `data` require gradients, so does the prediction, in a validation too.

        Args:
            data: The network's `net_fields`, any number of rows; other fields are ignored.
        """
        return predict(self.network, self.transformation, data)

    def __getitem__(self, rows: slice) -> PredictedBatch:
        """Return some of the rows."""
        parts = (self.data, self.inputs, self.output, self.prediction, self.targets)
        taken = ({name: values[rows] for name, values in part.items()} for part in parts)
        return PredictedBatch(self.network, self.transformation, *taken)


def pick(data: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return some of the fields."""
    picked = {}  # a loop, as a comprehension takes twice as long for few fields
    for name in names:
        picked[name] = data[name]
    return picked


def predict(network: Network, transformation: Transformation, data: Tensors) -> Tensors:
    """Return a network's prediction, both in physical units.

    Args:
        network: The network.
        transformation: The network's transformation.
        data: The network's `net_fields`.
    """
    output = network.predict(transformation.transform_before_prediction(data))
    return _to_physical(transformation, output, data)


def _to_physical(transformation: Transformation, output: Tensors, inputs: Tensors) -> Tensors:
    prediction = transformation.transform_before_apply(output)
    increments = transformation.increments
    return increments.add(prediction, inputs) if increments else prediction
