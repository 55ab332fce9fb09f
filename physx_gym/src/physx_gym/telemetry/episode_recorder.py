"""Recording of the episodes of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import ConfigError
from physx_gym.simulator.simulator import Simulator
from physx_gym.telemetry.episode_scene import Draw, EpisodeScene
from physx_gym.telemetry.log_folder import LogFolder
from physx_gym.telemetry.standard_columns import describe_simulator, register_simulator
from physx_gym.telemetry.telemetry import Telemetry


class EpisodeRecorder:
    """Records episodes: registered variables, measurements, and in evaluation everything else.

    Files without a given path are in a temporary folder that `close` removes.

    Attributes:
        telemetry: The registered variables and the recorded rows.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.telemetry = Telemetry()
        self._simulator = simulator
        self._folder = LogFolder()
        self._scene = EpisodeScene()
        self._reward = np.zeros(())
        self._action: tuple[Any, Any] | None = None  # if of another type, with its recorded copy
        self._in_detail = False
        self._described: dict[str, Any] = {}
        self._described_when: tuple[Any, ...] = ()

    def begin_training(self, name: str, constants: Mapping[str, Any]) -> None:
        """Start an episode that records only measurements and variables registered for training.

        Args:
            name: Name of the environment.
            constants: Description of the environment, besides that of its simulator.
        """
        self._in_detail, self._action = False, None
        self.telemetry.begin(None, self._describe(name, constants), training=True)

    def begin(
        self, name: str, action: Any, path: Any, constants: Mapping[str, Any], draw: Draw
    ) -> str:
        """Start an episode that records everything, and writes it to a file at its end.

        Args:
            name: Name of the environment.
            action: Buffer of the action; recorded if it is a single array of numbers.
            path: Path of the file; None: one in the temporary folder.
            constants: Description of the environment, besides that of its simulator.
            draw: Draws what is not simulated.

        Returns:
            The path of the file.
        """
        if path is not None and not isinstance(path, (str, Path)):
            raise ConfigError(f'The option "log_path" is {path!r} but must be a path.')
        described = self._describe(name, constants)
        self._in_detail = True
        self._register_action(action)
        self._register_reward()
        self._scene.begin(draw, self._simulator.simulation)
        file = self._folder.new_path(name) if path is None else Path(path)
        self.telemetry.begin(file, described)
        return str(file)

    def _describe(self, name: str, constants: Mapping[str, Any]) -> dict[str, Any]:
        """Register the simulator; return its and the environment's description."""
        simulator = self._simulator
        now = simulator.builds, simulator.control_period, simulator.observe_period, simulator.world
        if now != self._described_when:
            register_simulator(self.telemetry, simulator)
            self._described, self._described_when = describe_simulator(simulator), now
        return {"environment": name, **self._described, **constants}

    def _register_action(self, action: Any) -> None:
        self.telemetry.unregister("action")
        self._action = None
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiub":
            return
        is_recordable = action.dtype in (np.float64, np.int64)
        recorded = action if is_recordable else np.array(action, np.float64)
        self._action = None if is_recordable else (action, recorded)
        joints = [motor.joint for motor in self._simulator.motors]
        self.telemetry.register(
            "action", recorded, joints if action.shape == (len(joints),) else None
        )

    def _register_reward(self) -> None:
        """Register the reward: that of the step before each row."""
        self._reward[()] = 0.0
        self.telemetry.register("step", self._reward, namespace="reward")

    def end_step(self, reward: float, redraw: Draw) -> None:
        """Record the results of a step: its reward, drawings, contacts, and moved objects."""
        self._reward[()] = reward
        if self._in_detail and self.telemetry.is_recording:
            self._scene.record(self._simulator.stepper_state.t, redraw, self._simulator.simulation)

    def rewind(self, time: float) -> None:
        """Discard everything recorded from a time, in s, onward."""
        self.telemetry.rewind(time)
        self._scene.rewind(time)

    def record(self) -> None:
        """Record a row of the present values."""
        if self._in_detail:
            self._simulator.robot_state.refresh()
        if self._action is not None:
            self._action[1][...] = self._action[0]
        self.telemetry.record(self._simulator.stepper_state.t)

    def data(self) -> dict[str, Any]:
        """Return the recording, including the present state; see `Telemetry.log_data`."""
        if self.telemetry.is_recording:
            self.record()
            self._describe_scene()
        return self.telemetry.log_data

    def _describe_scene(self) -> None:
        if self._in_detail:
            self.telemetry.describe(self._scene.describe())

    def end(self, *, keep: bool) -> None:
        """End the episode, if one is being recorded.

        Args:
            keep: Whether to record the last state and write the file.
        """
        if not keep:
            self.telemetry.discard()
        elif self.telemetry.is_recording:
            self.record()
            self._describe_scene()
            self.telemetry.end()

    def close(self) -> None:
        """Remove the files in the temporary folder."""
        self._folder.close()
