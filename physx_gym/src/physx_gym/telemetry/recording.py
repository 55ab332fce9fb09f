"""What the base environment records of its episodes, and where to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.errors import ConfigError

if TYPE_CHECKING:
    from physx_gym.env.episodes import Episodes
    from physx_gym.env.layers.layer import Info, PipelineEnv
    from physx_gym.telemetry.log_folder import LogFolder
    from physx_gym.telemetry.telemetry import Telemetry


class Recording:
    """Telemetry of an environment, which is made when it is first needed.

    Files go to a folder of their own, which is removed when the environment is closed; one whose
    path is given by the option ``"log_path"`` of `reset` stays.
    """

    def __init__(self) -> None:
        self._telemetry: Telemetry | None = None
        self._folder: LogFolder | None = None
        self._action: tuple[Any, Any] | None = None  # of another type, and what is recorded of it

    @property
    def telemetry(self) -> Telemetry:
        """Where variables are registered."""
        if self._telemetry is None:
            from physx_gym.telemetry.telemetry import Telemetry

            self._telemetry = Telemetry()
        return self._telemetry

    def begin(self, env: Episodes, top: PipelineEnv, info: Info) -> bool:
        """Begin to record an episode, if that is wanted; return whether it is.

        In evaluation and with `debug` the file's path is put into the information.
        """
        if env.training and not env.debug:
            if self._telemetry is None:
                return False
            self.telemetry.begin(training=True)
            return self.telemetry.is_recording
        from physx_gym.telemetry.standard_columns import constants_of, register_simulator

        register_simulator(self.telemetry, env.simulator)
        self._register_action(env, top.action)
        path = self._path(env)
        info["log_path"] = str(path)
        self.telemetry.begin(path, constants_of(env))
        return True

    def _register_action(self, env: Episodes, action: Any) -> None:
        """Record the action, if it is one array of numbers."""
        self.telemetry.unregister("action")
        self._action = None
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiub":
            return
        kept = action.dtype in (np.float64, np.int64)
        recorded = action if kept else np.array(action, np.float64)
        self._action = None if kept else (action, recorded)
        joints = [motor.joint for motor in env.simulator.motors]
        self.telemetry.register(
            "action", recorded, joints if action.shape == (len(joints),) else None
        )

    def _path(self, env: Episodes) -> Path:
        given = env.reset_options.get("log_path")
        if given is not None:
            if not isinstance(given, (str, Path)):
                raise ConfigError(f'The option "log_path" is {given!r} but must be a path.')
            return Path(given)
        if self._folder is None:
            from physx_gym.telemetry.log_folder import LogFolder

            self._folder = LogFolder()
        return self._folder.new_path(type(env).__name__)

    def row(self, env: Episodes) -> None:
        """Record what is now."""
        env.robot_state.refresh()
        if self._action is not None:
            self._action[1][...] = self._action[0]
        if self._telemetry is not None:
            self._telemetry.record(env.stepper_state.t)

    def data(self, env: Episodes) -> dict[str, Any]:
        """Return what was recorded, the present state included; see `Telemetry.log_data`."""
        if self.telemetry.is_recording:
            self.row(env)
        return self.telemetry.log_data

    def rewind(self, time: float) -> None:
        """Forget what was recorded from a time on, in s: the episode goes on from there."""
        if self._telemetry is not None:
            self._telemetry.rewind(time)

    def discard(self) -> None:
        """End the episode without a file, if one is recorded."""
        if self._telemetry is not None and self._telemetry.is_recording:
            self._telemetry.discard()

    def end(self, env: Episodes) -> None:
        """Record the last state, and write the file, if there was a step."""
        telemetry = self._telemetry
        if telemetry is not None and telemetry.is_recording:
            if env.num_steps == 0:
                telemetry.discard()
                return
            self.row(env)
            telemetry.end()

    def close(self) -> None:
        """Remove the files whose path nobody gave."""
        if self._folder is not None:
            self._folder.close()
