"""A robot arm that follows trajectories using inverse dynamics learned by a network.

The arm is the Franka Emika Panda from the package ``example-robot-data``: seven joints in rad and
N m, then two fingers in m and N. A joint controller (proportional-derivative) runs at every
physics step; the environment adds torques to its output.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from physx_core import Field, plugins
from physx_core.components import Environment
from physx_core.errors import ConfigError, UnknownOptionError
from physx_core.typing import Sample, Vector
from physx_dart.environments.trajectories import SmoothTrajectory
from physx_sim import JointSettings, Mimic, Robot, Simulation, World
from physx_sim.engines import EXAMPLE_DATA, example_data_dir, example_robot

_ARM = "panda_description/urdf/panda.urdf"
_JOINTS = 7
"""Number of joints of the arm itself, without the fingers."""
_MARGIN = {"excite": 0.25, "track": 0.3}
"""Fraction of a joint's range that motions avoid at each end, so that tracked motions stay well
within the learned range."""
_SPEED = 0.7
"""Largest fraction of a joint's velocity limit that trajectories use."""
_FADE = 2.0
"""Fade-in time of trajectories to track, in s."""
_SETTLING = 0.2
"""Time, in s, that each new motion runs before sampling starts."""


class ArmEnvironment(Environment):
    """A seven-joint arm with two fingers, in one of two tasks.

    ``task="excite"`` generates training data. In each episode the arm moves randomly; each sample
    is the state (q, v, a) at one instant and the torque acting at that instant, so the state
    determines the torque through the arm's inverse dynamics.

    ``task="track"`` is for prediction. The arm follows trajectory number `trajectory`. Each step
    gives the reference (q, v, a) in the middle of the next control period as ``state``; the torque
    that the network predicts for it acts during that period in addition to the controller. The
    first step only gives the first reference, without any motion. Use ``simulations_per_step=1``.

    Args:
        task: ``"excite"`` or ``"track"``.
        feedforward: The torque added to the controller in the task ``"track"``: ``"network"``,
            ``"none"``, ``"model"`` (the engine's inverse dynamics of the reference: what a
            perfect network would predict) or ``"gravity"`` (the same at rest).
        trajectory: Number of the trajectory to track; the same number gives the same trajectory
            for any seed, instance and feed-forward.
        period: Length of a physics step, in s.
        steps_per_sample: Physics steps per step; a step is one control period.
        episode_steps: Number of steps after which the task ``"excite"`` draws a new motion.
        amplitude: Largest distance of a motion from its center, in rad.
        frequencies: Lowest and highest frequency of the motions, in Hz.
        excitation: Scale factor of the random torques in the task ``"excite"``.
        stiffness: Proportional gains of the controller, shape (9,).
        damping: Derivative gains of the controller, shape (9,).
        prediction_field: Name of the network's torque field; if the prediction has a single field,
            its name does not matter.
        draw_every: Number of steps between two updates of the viewer.
    """

    backend: ClassVar[str] = "dart"

    def __init__(
        self,
        *,
        task: str = "excite",
        feedforward: str = "network",
        trajectory: int = 0,
        period: float = 1e-3,
        steps_per_sample: int = 10,
        episode_steps: int = 50,
        amplitude: float = 0.5,
        frequencies: Sequence[float] = (0.2, 0.8),
        excitation: float = 1.0,
        stiffness: Sequence[float] = (400, 400, 400, 400, 100, 100, 30, 60, 60),
        damping: Sequence[float] = (20, 20, 10, 10, 2, 2, 0.5, 0.5, 0.5),
        prediction_field: str = "torque",
        draw_every: int = 1,
        **kwargs: Any,
    ) -> None:
        """Store the options.

        Raises:
            ConfigError: If an option is out of range.
        """
        super().__init__(**kwargs)
        for option, value, known in (
            ("task", task, ("excite", "track")),
            ("feedforward", feedforward, ("network", "none", "model", "gravity")),
        ):
            if value not in known:
                raise UnknownOptionError(option, [str(value)], known)
        for name, count in (
            ("steps_per_sample", steps_per_sample),
            ("episode_steps", episode_steps),
            ("draw_every", draw_every),
        ):
            if count < 1:
                raise ConfigError(f"{name} is {count} but must be at least 1.")
        if len(frequencies) != 2 or not 0 <= frequencies[0] <= frequencies[1]:
            raise ConfigError(
                f"frequencies are {frequencies} but must be the lowest and the highest."
            )
        self.task, self.feedforward, self.trajectory = task, feedforward, trajectory
        self.period, self.steps_per_sample = period, steps_per_sample
        self._episode_steps, self.draw_every = episode_steps, draw_every
        self.amplitude, self.excitation = amplitude, excitation
        self.frequencies = (float(frequencies[0]), float(frequencies[1]))
        self.stiffness, self.damping = _gains("stiffness", stiffness), _gains("damping", damping)
        self.prediction_field = prediction_field
        self.step_time = period * steps_per_sample
        self._steps = 0
        self._added = np.zeros(_JOINTS + 2)

    def create(self) -> None:
        """Build the simulation.

        Raises:
            ModelError: If the package ``example-robot-data`` is not installed.
        """
        free = {"panda_finger_joint2": JointSettings(mimic=Mimic(""))}  # each has its own torque
        path, folders = example_robot(_ARM), _package_dirs()
        self._robot = Robot(path, "arm", package_dirs=folders, joints=free)
        world = World([self._robot], period=self.period)
        self.simulation: Simulation = plugins.resolve("backend", self.backend).build(world)

    def init(self) -> None:
        """Draw the first motion; in the task ``"track"``, move the arm to its start."""
        if self.task == "track":
            self._motion = self._draw(np.random.default_rng(self.trajectory), _FADE)
            position, velocity, _ = self._motion.at(0.0)
            self.simulation.set_state(position, velocity)
            self._begin = self.simulation.frame

    def init_database(self) -> None:
        """Define ``state`` (q, v, a) and ``torque``, plus three more in the task ``"track"``."""
        n = len(self.simulation.layout.joints)
        unit = "rad, rad/s, rad/s^2; fingers: m, m/s, m/s^2"
        torque = Field("torque", shape=(n,), unit="N m; fingers: N")
        self.define_training_fields([Field("state", shape=(3 * n,), unit=unit), torque])
        if self.task == "track":
            self.define_additional_fields(
                [
                    Field("tracking_error", shape=(), unit="rad"),
                    Field("reference", shape=(n,), unit="rad; fingers: m"),
                    Field("position", shape=(n,), unit="rad; fingers: m"),
                ]
            )

    def step(self) -> None:
        """Simulate one control period, or replay a stored sample."""
        if self.sample is not None:
            self._replay(self.sample)
        elif self.task == "excite":
            self._excite()
        else:
            self._track()
        self._steps += 1
        if self.factory and self._steps % self.draw_every == 0:
            self._draw_robots()

    def apply_prediction(self, prediction: Sample) -> None:
        """Add a predicted torque to the controller during the next control period.

        Args:
            prediction: The network's fields, among them the torque, shape (9,), in N m or N.

        Raises:
            ConfigError: If there are several fields and none is named `prediction_field`, or the
                torque has the wrong shape.
        """
        if self.task != "track" or self.feedforward != "network":
            return
        name = self.prediction_field
        if name not in prediction and len(prediction) == 1:
            name = next(iter(prediction))
        if name not in prediction:
            raise ConfigError(
                f'prediction_field is "{name}" but the network predicts {sorted(prediction)}.'
            )
        torque = np.asarray(prediction[name], np.float64)
        if torque.shape != self._added.shape:
            raise ConfigError(
                f'The prediction "{name}" has the shape {torque.shape}, not {self._added.shape}.'
            )
        self._added = torque

    def close(self) -> None:
        """Free the simulation."""
        if hasattr(self, "simulation"):
            self.simulation.close()

    # Tasks ----------------------------------------------------------------------------------

    def _excite(self) -> None:
        if self._steps % self._episode_steps == 0:
            if self._steps:
                self.new_episode()
            self._motion = self._draw(self.rng, 0.0)
            limit = np.array([8.0, 8.0, 4.0, 4.0, 0.5, 0.5, 0.05, 0.1, 0.1]) * self.excitation
            nothing = np.zeros(len(limit))
            self._noise = SmoothTrajectory.draw(self.rng, nothing, limit, (0.5, 3.0))
            position, velocity, _ = self._motion.at(0.0)
            self.simulation.set_state(position, velocity)
            self._begin = self.simulation.frame
            self._advance(round(_SETTLING / self.period))
        torque = self._advance(self.steps_per_sample)
        q, v = self.simulation.positions(), self.simulation.velocities()
        a = self.simulation.forward_dynamics(q, v, torque)
        self.set_training_data(state=np.concatenate([q, v, a]), torque=torque)

    def _track(self) -> None:
        if self._steps:
            self._advance(self.steps_per_sample)
        reference, _, _ = self._motion.at(self._time())
        middle = self._motion.at(self._time() + 0.5 * self.steps_per_sample * self.period)
        model = self.simulation.inverse_dynamics(*middle)
        if self.feedforward == "model":
            self._added = model
        elif self.feedforward == "gravity":
            still = np.zeros(len(model))
            self._added = self.simulation.inverse_dynamics(middle[0], still, still)
        position = self.simulation.positions()
        error = (position - reference)[:_JOINTS]
        self.set_training_data(state=np.concatenate(middle), torque=model)
        self._error = float(np.sqrt(np.mean(error**2)))
        self._reference = reference
        self.set_additional_data(tracking_error=self._error, reference=reference, position=position)

    def _replay(self, sample: Sample) -> None:
        q, v, _ = np.split(np.asarray(sample["state"], np.float64), 3)
        self.simulation.set_state(q, v)
        self.set_training_data(**{name: sample[name] for name in ("state", "torque")})
        if self.task == "track":
            names = ("tracking_error", "reference", "position")
            self.set_additional_data(**{name: sample[name] for name in names})
            self._error, self._reference = float(sample["tracking_error"]), sample["reference"]
            self.simulation.set_state(sample["position"], v)

    def _advance(self, steps: int) -> Vector:
        """Simulate physics steps with the controller; return the torques of the last step."""
        simulation, limit = self.simulation, self.simulation.layout.max_torque
        times = self._time() + self.period * np.arange(steps, dtype=np.float64)
        positions, velocities, _ = self._motion.along(times)
        added = np.broadcast_to(self._added, positions.shape)
        if self.task == "excite":
            added = self._noise.along(times)[0]
        torque = added[0]
        for position, velocity, extra in zip(positions, velocities, added, strict=True):
            torque = extra + self.stiffness * (position - simulation.positions())
            torque += self.damping * (velocity - simulation.velocities())
            torque = np.minimum(np.maximum(torque, -limit), limit)
            simulation.set_torques(torque)
            simulation.step()
        return torque

    def _draw(self, rng: np.random.Generator, fade_time: float) -> SmoothTrajectory:
        """Draw a motion within the position and velocity limits."""
        layout = self.simulation.layout
        span = layout.upper - layout.lower
        margin = _MARGIN[self.task] * span
        lower, upper = layout.lower + margin, layout.upper - margin
        # Fading in adds at most 15 / 8 * amplitude / fade-in time to the velocity.
        rate = 2 * np.pi * self.frequencies[1] + (1.875 / fade_time if fade_time else 0.0)
        largest = np.minimum(0.5 * (upper - lower), _SPEED * layout.max_velocity / rate)
        largest = np.minimum(largest, self.amplitude) * rng.uniform(0.4, 1.0, len(span))
        center = rng.uniform(lower + largest, upper - largest)
        return SmoothTrajectory.draw(rng, center, largest, self.frequencies, fade_time=fade_time)

    def _time(self) -> float:
        return (self.simulation.frame - self._begin) * self.period

    # Drawing --------------------------------------------------------------------------------

    def init_visualization(self) -> None:
        """Add the arm; in the task ``"track"``, also its translucent reference and the error."""
        factory = self.factory
        bodies = self.simulation.layout.bodies
        urdf, packages = str(self._robot.urdf), {k: str(v) for k, v in _package_dirs().items()}
        poses = self.simulation.body_poses()
        factory.add_robot("arm", urdf, bodies, package_dirs=packages, poses=poses)
        content = f"Franka Emika Panda in {self.backend}, task {self.task}"
        if self.task == "track":
            look = {"color": "green", "alpha": 0.3, "poses": poses}
            factory.add_robot("reference", urdf, bodies, package_dirs=packages, **look)
            factory.add_scalars("tracking_error", ["joint error (rad)"])
            content += f", trajectory {self.trajectory}, feed-forward: {self.feedforward}"
        factory.add_text("task", content)

    def _draw_robots(self) -> None:
        factory = self.factory
        factory.update_robot("arm", poses=self.simulation.body_poses())
        if self.task == "track":
            poses = self.simulation.body_poses(positions=self._reference)
            factory.update_robot("reference", poses=poses)
            factory.update_scalars("tracking_error", [self._error])


class DartArm(ArmEnvironment):
    """The arm in DART."""

    backend = "dart"


class PinocchioArm(ArmEnvironment):
    """The arm in Pinocchio."""

    backend = "pinocchio"


def _package_dirs() -> dict[str, str]:
    folder = example_data_dir()
    return {} if folder is None else {EXAMPLE_DATA: str(folder)}


def _gains(name: str, given: Sequence[float]) -> Vector:
    gains = np.array(given, np.float64)
    if gains.shape != (_JOINTS + 2,) or not (gains >= 0).all():
        raise ConfigError(f"{name} needs {_JOINTS + 2} numbers of at least 0, not {given}.")
    return gains
