"""Fields, batches and learners shared by the checks of learning components."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from physx_core import Normalization
from physx_core.components import Network
from physx_core.config import NetworkConfig
from physx_core.errors import MissingLibraryError
from physx_core.fields import Field
from physx_core.pipelines import Learner
from physx_core.plugins import create_network
from physx_core.typing import Batch
from physx_testing.report import NotApplicableError
from physx_testing.subject import expect, expect_close

SHAPES: Sequence[tuple[tuple[int, ...], tuple[int, ...]]] = (
    ((4,), (3,)),
    ((4,), (4,)),
    ((2,), (2,)),
    ((), ()),
    ((8, 8), (8, 8)),
    ((16, 16, 1), (16, 16, 1)),
    ((16, 16, 3), (16, 16, 3)),
    ((16, 16, 1), (16, 16, 3)),
    ((8, 8, 8, 1), (8, 8, 8, 3)),
)
"""Shapes of inputs and targets to try in turn if no fields are given."""
SEED = 3
ROWS = 8
_OF_CODE = (TypeError, AttributeError, NameError)
"""Errors that are mistakes in code if they are the same for all fields."""
TOLERANCE = 1e-4
"""For float32, where sums may round differently with a different number of rows."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A network and the fields to check it with.

    Attributes:
        config: The network, with its transformation and optimization.
        fields: Its fields.
    """

    config: NetworkConfig
    fields: Sequence[Field]

    def learner(
        self, *, trains: bool = False, seed: int = SEED, normalized: bool = False
    ) -> Learner:
        """Return a new learner for the fields, as a training would create it."""
        type(create_network(self.config)).set_seed(seed)
        made = Learner(self.config, trains=trains)
        made.bind(
            {field.name: field for field in self.fields}, self.normalization if normalized else {}
        )
        made.network.set_train() if trains else made.network.set_eval()
        return made

    @property
    def normalization(self) -> dict[str, Normalization]:
        """Statistics of the fields; if a field has several components, one of them is constant."""
        found = {}
        for number, field in enumerate(self.fields):
            shape = field.shape or ()
            size = int(np.prod(shape))
            places = np.arange(size, dtype=np.float64).reshape(shape)
            std = np.where(places == size - 1, 1.0, 0.5 + number + places / size)
            mean = places - 3.0 * number
            found[field.name] = Normalization(mean, std, mean - 4 * std, mean + 4 * std)
        return found

    def batch(self, rows: int = ROWS, seed: int = 0) -> Batch:
        """Return rows of the fields: targets are a linear function of the inputs."""
        random = np.random.default_rng(seed)
        names, batch = self.network_fields, {}
        for field in self.fields:
            if field.name in names or field.numpy_dtype.kind not in "fc":
                values = random.standard_normal((rows, *(field.shape or ())))
                if field.numpy_dtype.kind not in "fc":
                    values = np.rint(np.abs(values) % 2) % 2  # every type can hold 0 and 1
                batch[field.name] = values.astype(field.numpy_dtype)
        flat = [batch[name].reshape(rows, -1) for name in names]
        inputs = np.concatenate(flat, axis=1)
        for field in self.fields:
            if field.name not in batch:
                size = int(np.prod(field.shape or ()))
                matrix = np.sin(np.arange(inputs.shape[1] * size)).reshape(-1, size)
                values = inputs @ matrix / np.sqrt(len(matrix)) + 0.5
                shaped = values.reshape(rows, *(field.shape or ()))
                batch[field.name] = shaped.astype(field.numpy_dtype)
        return batch

    @property
    def network_fields(self) -> Sequence[str]:
        """Names of the fields that the network reads."""
        return tuple(create_network(self.config).net_fields)


def predict(learner: Learner, batch: Batch) -> Batch:
    """Return a prediction; neither what is given nor what is returned is used elsewhere."""
    found = learner.predict({name: values.copy() for name, values in batch.items()})
    return {name: np.array(values) for name, values in found.items()}


def expect_rows_apart(learner: Learner, batch: Batch) -> None:
    """Check that each row is predicted alone as it is in a batch of `ROWS`."""
    together = predict(learner, batch)
    for row in range(ROWS):
        alone = predict(learner, {name: values[row : row + 1] for name, values in batch.items()})
        for name, values in alone.items():
            rows = len(together[name])
            expect(rows == ROWS, f'"{name}" has {rows} rows for {ROWS} samples')
            text = f'"{name}" of a sample alone and in a batch of {ROWS} differ'
            expect_close(values[0], together[name][row], TOLERANCE, text)


def find_case(config: NetworkConfig, fields: Sequence[Field]) -> Case:
    """Return a network with fields that it accepts.

    Args:
        config: The network.
        fields: Its fields; empty: those of `SHAPES` are tried.

    Raises:
        NotApplicableError: If it accepts none of those that are tried.
        TypeError: If it raises this, or another error of mistakes in code, for all of them.
    """
    config = dataclasses.replace(config, device="cpu")
    if fields:
        return Case(config, tuple(fields))
    reasons: list[Exception] = []
    for chosen in _candidates(create_network(config)):
        case = Case(config, chosen)
        try:
            case.learner().predict(case.batch(2))
        except MissingLibraryError:
            raise
        except Exception as error:
            reasons.append(error)
            continue
        return case
    if isinstance(reasons[0], _OF_CODE) and len(set(map(repr, reasons))) == 1:
        raise reasons[0]
    raise NotApplicableError(
        "it accepts none of the fields that were tried: specify the fields it is made for (the "
        f"first error: {reasons[0]})"
    )


def _candidates(network: Network) -> Iterator[list[Field]]:
    targets = [name for name in network.opt_fields if name not in network.net_fields]
    for read, compared in SHAPES:
        yield [
            *(Field(name, read) for name in network.net_fields),
            *(Field(name, compared) for name in targets),
        ]


def parameters_of(network: Network) -> Batch:
    """Return copies of a network's parameters."""
    arrays = network.tensor_to_numpy(network.get_parameters())
    return {name: np.array(values) for name, values in arrays.items()}
