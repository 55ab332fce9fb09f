"""The plugin ``toy``: a spring and a linear model in pure NumPy.

For documentation and tests; registered with the same hooks as any plugin.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.components.environment import Environment
from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.components.predicted_batch import PredictedBatch
from physx_core.components.transformation import Transformation
from physx_core.errors import CheckpointError, ConfigError, FieldsMismatchError
from physx_core.fields import Field
from physx_core.plugins import hookimpl
from physx_core.typing import Array, Batch, Tensors

_LONGEST_HEADER = 2**14
_WIDEST = 16
_UNREADABLE = (
    OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error
)  # fmt: skip


class Spring(Environment):
    """A damped mass on a spring under a random force, integrated with semi-implicit Euler steps.

    Each sample contains the ``state`` (position in m, velocity in m/s) and ``force`` before the
    step and the ``next_state`` after it. Replaying a stored sample starts from its state and
    applies its force.
    """

    def __init__(
        self,
        *,
        mass: float = 1.0,
        stiffness: float = 20.0,
        damping: float = 0.5,
        period: float = 0.02,
        **kwargs: Any,
    ) -> None:
        """Set the parameters.

        Args:
            mass: Mass in kg.
            stiffness: Stiffness of the spring in N/m.
            damping: Damping in N s/m.
            period: Duration of a step in s.
            kwargs: See `Environment`.
        """
        super().__init__(**kwargs)
        self.mass, self.stiffness, self.damping = mass, stiffness, damping
        self.period = period
        self.predicted: Array | None = None

    def create(self) -> None:
        """Place the mass at random."""
        self.step_time = self.period
        self.state = self.rng.standard_normal(2)

    def init_database(self) -> None:
        """Define the three fields."""
        self.define_training_fields(
            [
                Field("state", (2,), unit="m, m/s"),
                Field("force", (1,), unit="N"),
                Field("next_state", (2,), unit="m, m/s", like="state"),
            ]
        )

    def init_visualization(self) -> None:
        """Draw the mass and the spring."""
        title = f"spring {self.instance_id}"
        self.factory.set_view(title, eye=[-1.5, -6, 1.5], target=[-1.5, 0, 0])
        self.factory.add_sphere("mass", 0.2, color="orange")
        self.factory.add_lines("spring", [[-3, 0, 0], [0, 0, 0]], color="gray", size=0.02)

    def reset_parameters(self, **values: Any) -> None:
        """Place the mass at random, in an independent episode."""
        self.state = self.rng.standard_normal(2)

    def step(self) -> None:
        """Move the mass by one period."""
        if self.sample is None:
            force = self.rng.standard_normal(1)
        else:
            self.state, force = self.sample["state"], self.sample["force"]
        position, velocity = self.state
        pull = force[0] - self.stiffness * position - self.damping * velocity
        velocity = velocity + self.period * pull / self.mass
        following = np.array([position + self.period * velocity, velocity])
        self.set_training_data(state=self.state, force=force, next_state=following)
        self.state = following
        if self.factory:
            self._draw(following[0])

    def apply_prediction(self, prediction: Batch) -> None:
        """Draw the predicted mass, translucent, at the next step."""
        if self.factory:
            if self.predicted is None:
                self.factory.add_sphere("prediction", 0.2, color="blue", alpha=0.4)
            self.predicted = next(iter(prediction.values()))

    def _draw(self, position: float) -> None:
        self.factory.update_sphere("mass", position=[position, 0, 0])
        if self.predicted is not None:
            self.factory.update_sphere("prediction", position=[self.predicted[0], 0, 0])
        self.factory.update_lines("spring", positions=[[-3, 0, 0], [position, 0, 0]])


class Linear(Network):
    """Predicts a field as a linear function of others; its tensors are NumPy arrays."""

    default_optimization = "toy/least-squares"
    default_transformation = "toy/identity"

    def __init__(
        self,
        net_fields: list[str] | str = "state",
        opt_fields: list[str] | str = "next_state",
    ) -> None:
        """Choose the fields.

        Args:
            net_fields: Names of the input fields.
            opt_fields: Name of the predicted field.
        """
        self.net_fields = [net_fields] if isinstance(net_fields, str) else list(net_fields)
        self.opt_fields = [opt_fields] if isinstance(opt_fields, str) else list(opt_fields)
        if len(self.opt_fields) != 1:
            raise ConfigError("toy/linear predicts one field: give one name in opt_fields.")
        self.pred_fields = self.opt_fields
        self.weights: Array = np.zeros((0, 0))
        self._shape: tuple[int, ...] = ()
        self._dtype = "float64"

    def bind(self, fields: dict[str, Field]) -> None:  # type: ignore[override]
        """Set the sizes from the fields; existing weights are kept."""
        super().bind(fields)
        self.reject_free_axes(fields)
        none = {name: np.zeros((0, *(fields[name].shape or ()))) for name in self.net_fields}
        self._shape = fields[self.opt_fields[0]].shape or ()
        size = (self.rows(none).shape[1], int(np.prod(self._shape)))
        if self.weights.size == 0:
            self.weights = np.zeros(size, self._dtype)
        elif self.weights.shape != size:
            was = f"weights have shape {self.weights.shape}, expected {size}"
            raise FieldsMismatchError("toy/linear was created for other fields", {"weights": was})

    def rows(self, data: Tensors) -> Array:
        """Return the inputs and a column of ones, shape (samples, inputs + 1)."""
        given = [data[name] for name in self.net_fields]
        parts = [each.reshape(len(each), math.prod(each.shape[1:])) for each in given]
        return np.concatenate([*parts, np.ones((len(parts[0]), 1))], axis=1)

    def predict(self, data: Tensors) -> Tensors:
        """Return the linear function of the inputs, by field."""
        return {self.pred_fields[0]: self.forward(*(data[name] for name in self.net_fields))}

    def forward(self, *inputs: Array) -> Array:
        """Return the linear function of the inputs."""
        flat = self.rows(dict(zip(self.net_fields, inputs, strict=True))) @ self.weights
        return flat.reshape(len(flat), *self._shape)

    def set_data_type(self, data_type: str) -> None:
        """Set the type to compute in."""
        self._dtype = data_type

    def get_parameters(self) -> dict[str, Any]:
        """Return the weights, shape (inputs + 1, outputs)."""
        return {"weights": self.weights}

    def load_parameters(self, path: Path) -> None:
        """Read the weights from an npz file."""
        try:
            with zipfile.ZipFile(path) as stored, stored.open("weights.npy") as file:
                nbytes = stored.getinfo("weights.npy").file_size
                if nbytes > self.weights.size * _WIDEST + _LONGEST_HEADER:
                    raise ValueError(f"{nbytes} bytes are too many")
                weights = np.lib.format.read_array(file, allow_pickle=False)
        except _UNREADABLE as error:
            raise CheckpointError(
                f"{path} does not contain weights of toy/linear: {error}."
            ) from error
        if self.weights.size and weights.shape != self.weights.shape:
            raise CheckpointError(
                f"{path} contains weights {weights.shape}, not {self.weights.shape}."
            )
        self.weights = weights


class LeastSquares(Optimization):
    """Solves for the weights that fit all batches so far; the loss is the mean squared error."""

    state_file = "normal_equations.npz"

    def set_loss(self, loss: str | type[Any] | None) -> None:
        """Accept only the mean square."""
        if loss is not None:
            raise ConfigError("toy/least-squares uses the mean square as its loss: leave out loss.")

    def set_optimizer(
        self, optimizer: str | type[Any] | None, network: Network, **kwargs: Any
    ) -> None:
        """Set the network whose weights are solved for."""
        if optimizer is not None or kwargs or not isinstance(network, Linear):
            raise ConfigError("toy/least-squares solves for toy/linear and takes no optimizer.")
        self._network = network
        self._normal: Array | None = None
        self._right: Array | None = None

    def compute_loss(self, batch: PredictedBatch) -> Any:
        """Return the mean squared difference and keep the batch for `optimize`."""
        self._rows = self._network.rows(batch.data)
        target = batch.targets[self._network.opt_fields[0]]
        self._targets = target.reshape(len(target), -1)
        return float(np.mean(self._errors(batch) ** 2))

    def compute_row_losses(self, batch: PredictedBatch) -> Any:
        """Return the mean squared difference of each row."""
        error = self._errors(batch)
        return np.mean((error**2).reshape(len(error), -1), axis=1)

    def _errors(self, batch: PredictedBatch) -> Array:
        predicted, target = self._network.pred_fields[0], self._network.opt_fields[0]
        errors: Array = batch.prediction[predicted] - batch.targets[target]
        return errors

    def optimize(self, loss: Any) -> None:
        """Add the batch to the normal equations and solve them."""
        normal, right = self._rows.T @ self._rows, self._rows.T @ self._targets
        self._normal = normal if self._normal is None else self._normal + normal
        self._right = right if self._right is None else self._right + right
        self._network.weights = np.linalg.lstsq(self._normal, self._right, rcond=None)[0]

    def save_state(self, path: Path) -> None:
        """Write the normal equations of all batches so far."""
        nothing = np.zeros((0, 0))
        with path.open("wb") as file:
            np.savez(
                file,
                normal=nothing if self._normal is None else self._normal,
                right=nothing if self._right is None else self._right,
            )

    def load_state(self, path: Path) -> None:
        """Read the normal equations."""
        size, outputs = self._network.weights.shape
        try:
            with np.load(path, allow_pickle=False) as stored:
                if sum(item.file_size for item in stored.zip.infolist()) > (
                    size * (size + outputs) * _WIDEST + 2 * _LONGEST_HEADER
                ):
                    raise ValueError("it is too large")
                normal, right = stored["normal"], stored["right"]
        except _UNREADABLE as error:
            raise CheckpointError(
                f"{path} does not contain a state of toy/least-squares: {error}."
            ) from error
        if not normal.size:
            self._normal = self._right = None
        elif (normal.shape, right.shape) == ((size, size), (size, outputs)):
            self._normal, self._right = normal, right
        else:
            raise CheckpointError(f"{path} is the state of a training with other fields.")


@hookimpl
def physx_environments() -> dict[str, Any]:
    """Return the spring."""
    return {"spring": Spring}


@hookimpl
def physx_networks() -> dict[str, Any]:
    """Return the linear model."""
    return {"linear": Linear}


@hookimpl
def physx_optimizations() -> dict[str, Any]:
    """Return the least-squares solver."""
    return {"least-squares": LeastSquares}


@hookimpl
def physx_transformations() -> dict[str, Any]:
    """Return the identity."""
    return {"identity": Transformation}
