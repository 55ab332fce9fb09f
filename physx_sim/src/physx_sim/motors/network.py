"""Actuator networks: torques of motors beyond their commands, learned from logs.

A file of ``physx identify --actuator`` holds the weights of a small network for each joint, in the
safetensors format, which contains no code. Its inputs are the torque on the joint and the joint's
velocity, now and at the samples before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import ConfigError
from physx_core.files import read_content, replace
from physx_core.typing import Vector
from physx_sim.devices import steps_of
from physx_sim.motors.motor import Motor

_LARGEST = 2**26


@dataclass(frozen=True, eq=False)
class ActuatorNetwork:
    """What the actuator of one joint exerts beyond its command.

    Attributes:
        period: Time between the samples of its inputs, in s.
        layers: Weights, shape (outputs, inputs), and biases, shape (outputs,); between layers tanh
            applies. The inputs are torques in N m or N, the latest first, then as many velocities
            in rad/s or m/s; the output is a torque.
        limit: Largest torque that it may add, in N m or N.

    Raises:
        ConfigError: If layers do not fit together, or a number is out of range.
    """

    period: float
    layers: Sequence[tuple[Vector, Vector]]
    limit: float

    def __post_init__(self) -> None:
        width = self.layers[0][0].shape[1] if self.layers else 1
        if width % 2 or not self.period > 0 or not 0 <= self.limit < np.inf:
            raise ConfigError("An actuator network needs inputs, a period and a limit.")
        for weights, biases in self.layers:
            if weights.shape[1] != width or biases.shape != weights.shape[:1]:
                raise ConfigError("The layers of an actuator network do not fit together.")
            width = len(weights)
        if width != 1:
            raise ConfigError("An actuator network needs one output.")

    @property
    def samples(self) -> int:
        """Number of samples of each input."""
        return int(self.layers[0][0].shape[1] // 2)

    def __call__(self, inputs: Vector) -> Vector:
        """Return the added torques for inputs, shape (..., 2 samples): shape (...)."""
        values, last = inputs, len(self.layers) - 1
        for place, (weights, biases) in enumerate(self.layers):
            values = values @ weights.T + biases
            if place < last:
                values = np.tanh(values)
        return np.minimum(np.maximum(values[..., 0], -self.limit), self.limit)


def write_actuators(path: str | Path, networks: Mapping[str, ActuatorNetwork]) -> None:
    """Write networks, by their joints' names, to a file.

    Raises:
        ConfigError: If it cannot be written.
    """
    from safetensors.numpy import save

    arrays: dict[str, Any] = {}
    for joint, network in networks.items():
        arrays[f"{joint}:period"] = np.array([network.period])
        arrays[f"{joint}:limit"] = np.array([network.limit])
        for place, (weights, biases) in enumerate(network.layers):
            arrays[f"{joint}:{place}:weights"] = np.array(weights, order="C")
            arrays[f"{joint}:{place}:biases"] = np.array(biases, order="C")
    try:
        replace(Path(path), save(arrays))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}.") from error


def read_actuators(path: str | Path) -> dict[str, ActuatorNetwork]:
    """Return the networks in a file, by their joints' names.

    Raises:
        ConfigError: If there is no such file, or it is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(read_content(Path(path), _LARGEST))
        found = {}
        ends = ":period"
        for joint in sorted(name.removesuffix(ends) for name in arrays if name.endswith(ends)):
            layers: list[tuple[Vector, Vector]] = []
            while (layer := f"{joint}:{len(layers)}:") + "weights" in arrays:
                given = (arrays[layer + part] for part in ("weights", "biases"))
                weights, biases = (np.asarray(each, np.float64) for each in given)
                layers.append((weights, biases))
            if not all(np.isfinite(each).all() for layer in layers for each in layer):
                raise ConfigError("a weight is not finite")
            period, limit = (float(arrays[f"{joint}:{each}"][0]) for each in ("period", "limit"))
            found[joint] = ActuatorNetwork(period, layers, limit)
        if len(arrays) != sum(2 + 2 * len(network.layers) for network in found.values()):
            raise ConfigError("it holds other arrays")
    except (OSError, ValueError, LookupError, TypeError, SafetensorError, ConfigError) as error:
        raise ConfigError(
            f"{path} is not a file of actuator networks: {error}. "
            "Make one:  physx identify LOG ROBOT --actuator FILE"
        ) from error
    return found


class AddedTorques:
    """Torques that networks add to those of motors, from what these did before.

    Attributes:
        places: Indices of the motors that have networks.
        history: Torques, then velocities, the latest first, shape (networks, 2, samples), padded to
            the longest.
        added: Torques since the last sample, shape (networks,), in N m or N.
    """

    def __init__(self, motors: Sequence[Motor], period: float) -> None:
        """Load the networks.

        Args:
            motors: The motors.
            period: The physics period, in s.

        Raises:
            ConfigError: If a file cannot be read, has no network of the joint, or its period is not
                a multiple of the physics period.
        """
        owners = [(place, motor) for place, motor in enumerate(motors) if motor.network is not None]
        self.places = np.array([place for place, _ in owners], np.intp)
        self._networks, self._every = [], []
        for _, motor in owners:
            known = read_actuators(str(motor.network))
            joint = motor.joint if motor.joint in known else motor.joint.rpartition("/")[2]
            if joint not in known:
                raise ConfigError(
                    f'{motor.network} has no network of "{motor.joint}"; it has: {sorted(known)}.'
                )
            self._networks.append(known[joint])
            where = f'Motor of "{motor.joint}": period of its network'
            self._every.append(steps_of(where, known[joint].period, period))
        longest = max((each.samples for each in self._networks), default=0)
        self.history = np.zeros((len(owners), 2, longest))
        self.added = np.zeros(len(owners))

    def reset(self) -> None:
        """Start at rest."""
        self.history[:], self.added[:] = 0.0, 0.0

    def update(self, torques: Vector, velocities: Vector, frame: int) -> Vector:
        """Return the added torques in this physics step, shape (networks,).

        Args:
            torques: Torques on the joints without them, shape (networks,), in N m or N.
            velocities: Velocities of the joints, shape (networks,), in rad/s or m/s.
            frame: Number of physics steps until now.
        """
        for place, (network, every) in enumerate(zip(self._networks, self._every, strict=True)):
            if frame % every == 0:
                own, samples = self.history[place], network.samples
                own[:, 1:] = own[:, :-1]
                own[:, 0] = torques[place], velocities[place]
                self.added[place] = network(own[:, :samples].ravel())
        return self.added
