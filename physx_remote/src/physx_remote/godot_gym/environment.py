"""RLEnvironment: an environment that is driven from another process, over any physics engine."""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Generator, Iterator
from typing import Any, Self, TypeAlias

import gymnasium
import numpy as np

from physx_core.errors import RequestError, UsageError
from physx_core.simulation import Simulation
from physx_remote.godot_gym.communication import Communication
from physx_remote.godot_gym.frames_timer import PhysicsFramesTimer
from physx_remote.godot_gym.messages import DESCRIPTION, Messages, encode_extension
from physx_remote.godot_gym.parts import RLAgent, RLEnvWorld
from physx_remote.godot_gym.requests import as_count, as_object, as_seed, as_speed
from physx_remote.serving.spaces import describe_space

FRAME_TIME = 1 / 60
"""Length of a physics frame in s, as near as whole physics steps come to it."""

_SLICE = 0.02

Stepping: TypeAlias = Generator[Any, Any, Any] | Awaitable[Any] | None
"""What `RLEnvironment._step` returns: a generator, a coroutine, or None if all is done."""


class RLEnvironment:
    """An agent and a world, driven by the requests of a client.

    A subclass sets `agent`, `world` and mostly `simulation` in `_ready`, and implements `_reset`.
    Physics runs only within a step: between requests nothing moves, and the process does whatever
    else it has to do.

    A request is an object of JSON with any of these keys. Of the first three the first that is
    there counts and the others are ignored; the observation comes after it.

    - ``reset`` with any value: `_reset` is called. From an object with a number ``seed`` a new
      `rng` is made first.
    - ``action`` with any value: `_step` is called with it.
    - ``config``: `_configure` is called with it.
    - ``observation``: an object with any of ``agent`` and ``world``, whose values are given to
      their `get_data`, and ``environment``, which is answered with the description of the messages
      and spaces.

    Attributes:
        agent: What acts; set by the user.
        world: What is around it; set by the user.
        simulation: Physics that is stepped; None: agent and world do all in `_physics_process`.
        messages: Messages of the answers: `Messages`, a module made by ``protoc``, or its class
            ``Message``; set by the user.
        observation_space: Space of the observations, for clients that ask; None: not told.
        action_space: Likewise for the actions.
        communication: The server.
        physics_frames_timer: Counts the physics frames of a step.
        time_speed: How many times faster than the clock on the wall simulated time passes within a
            step; None: as fast as it can. The length of physics steps does not depend on it.
        paused: Whether physics stands still.
        rng: Random numbers for `_reset` and whatever comes after it.
        reset_request: Value of the last request to reset.
    """

    CONFIG_KEY = "config"
    RESET_KEY = "reset"
    ACTION_KEY = "action"
    OBSERVATION_KEY = "observation"
    WORLD_KEY = "world"
    AGENT_KEY = "agent"
    ENVIRONMENT_KEY = "environment"
    REPEAT_ACTION_KEY = "repeat_action"
    TIME_SPEED_KEY = "time_speed"
    SEED_KEY = "seed"

    def __init__(self) -> None:
        """Make an environment without agent, world and simulation; `_ready` sets them."""
        self.agent: RLAgent | None = None
        self.world: RLEnvWorld | None = None
        self.messages: Any = None
        self.observation_space: gymnasium.Space[Any] | None = None
        self.action_space: gymnasium.Space[Any] | None = None
        self.communication = Communication()
        self.physics_frames_timer = PhysicsFramesTimer()
        self.time_speed: float | None = None
        self.paused = True
        self.rng = np.random.default_rng()
        self.reset_request: Any = None
        self.simulation: Simulation | None = None
        self._frame_steps: int | None = None
        self._repeat_action = 4
        self._is_ready = False

    @property
    def repeat_action(self) -> int:
        """How many physics frames one action lasts, 4 unless set."""
        return self._repeat_action

    @repeat_action.setter
    def repeat_action(self, frames: int) -> None:
        self._repeat_action = as_count(self.REPEAT_ACTION_KEY, frames)
        self.physics_frames_timer.set_limit(self._repeat_action)

    @property
    def frame_steps(self) -> int:
        """How many physics steps one physics frame has; unless set, as fit best into 1/60 s."""
        if self._frame_steps is not None:
            return self._frame_steps
        if self.simulation is None:
            return 1
        return max(1, round(FRAME_TIME / self.simulation.period))

    @frame_steps.setter
    def frame_steps(self, steps: int) -> None:
        self._frame_steps = as_count("frame_steps", steps, 1)

    @property
    def frame_time(self) -> float:
        """Simulated time of one physics frame, in s."""
        simulation = self.simulation
        return FRAME_TIME if simulation is None else self.frame_steps * simulation.period

    # Running --------------------------------------------------------------------------------

    def open(self) -> None:
        """Bring the environment to life; calling it again does nothing."""
        if not self._is_ready:
            self._enter_tree()
            self._ready()
            self._is_ready, self.time_speed = True, as_speed(self.time_speed)
            self.messages = None if self.messages is None else Messages(self.messages)

    def run(self) -> None:
        """Serve at the address that `_ready` began to listen at, until Ctrl-C or `close`.

        Raises:
            UsageError: Nothing listens.
        """
        self.open()
        if not self.communication.is_listening:
            raise UsageError(
                "Call self.communication.start_server(port, address) in _ready(), or serve the "
                'environment with physx_remote.serve(environment, "godot-gym", port=...).'
            )
        try:
            while self._process(None):
                continue
        except KeyboardInterrupt:
            return

    def close(self) -> None:
        """End all connections and the simulation; calling it again does nothing."""
        self.communication.close()
        if self.simulation is not None:
            self.simulation.close()

    def __enter__(self) -> Self:
        """Bring the environment to life."""
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        """Close the environment."""
        self.close()

    def _enter_tree(self) -> None:
        """Pause physics and take requests; called once, before `_ready`."""
        self.paused = True
        self.communication.got_connection.connect(self._on_got_connection)

    def _ready(self) -> None:
        """Set agent, world, simulation and messages; a subclass implements it.

        It may call ``self.communication.start_server(9090, "127.0.0.1")``; otherwise the
        environment listens where it is told when it is served.
        """
        raise UsageError(f"{type(self).__name__} does not implement _ready().")

    def _process(self, delta: float | None = 0.0) -> bool:
        """Handle the requests that have arrived.

        Args:
            delta: How long to wait for the first one, in s; None: until there is one.

        Returns:
            False once the environment is closed.
        """
        return self.communication.server_poll(delta)

    def _physics_process(self, delta: float) -> None:
        """Count a physics frame that begins.

        Args:
            delta: Length of the frame, in s.
        """
        self.physics_frames_timer.step()

    # What a subclass may override -------------------------------------------------------------

    def _step(self, action: Any) -> Stepping:
        """Give the agent its action and let physics run for `repeat_action` frames.

        A subclass may do more before and after, as a generator or as a coroutine::

            def _step(self, action):
                ...
                yield from super()._step(action)
                ...

        or do without the original::

            async def _step(self, action):
                self.agent.set_action(action)
                self.paused = False
                await self.physics_frames_timer.start()
                self.paused = True

        Args:
            action: What `RLAgent.set_action` is given.
        """
        self._required_agent().set_action(action)
        self.paused = False
        yield self.physics_frames_timer.start()
        self.paused = True

    def _reset(self) -> None:
        """Begin anew; a subclass implements it, with `rng` where it draws at random.

        For example::

            def _reset(self):
                self.world.reset()
                self.agent.reset(self.world.sample_initial_position(self.rng))
        """
        raise UsageError(f"{type(self).__name__} does not implement _reset().")

    def _after_send_response(self) -> None:
        """Do what is to be done after each answer, for example forget recorded frames."""

    # Requests -------------------------------------------------------------------------------

    def _on_got_connection(self, request: dict[str, Any]) -> Iterator[float]:
        """Carry out one request and answer it."""
        if self.RESET_KEY in request:
            self._seed(request[self.RESET_KEY])
            self._reset()
        elif self.ACTION_KEY in request:
            yield from self._run(self._step(request[self.ACTION_KEY]))
        elif self.CONFIG_KEY in request:
            self._configure(as_object(self.CONFIG_KEY, request[self.CONFIG_KEY]))
        if self.OBSERVATION_KEY in request:
            self._send_response(as_object(self.OBSERVATION_KEY, request[self.OBSERVATION_KEY]))
        else:
            self.communication.put_message()
        self._after_send_response()

    def _send_response(self, observation_request: dict[str, Any]) -> None:
        """Gather what is asked for and answer with it.

        Args:
            observation_request: Dictionary with any of the keys ``agent`` and ``world``; or with
                ``environment``, for the description.
        """
        if self.ENVIRONMENT_KEY in observation_request:
            self.communication.put_message(encode_extension(DESCRIPTION, self._described()))
            return
        message = self._message()
        if self.AGENT_KEY in observation_request:
            storage = message.agent_data
            storage.SetInParent()
            self._required_agent().get_data(observation_request[self.AGENT_KEY], storage)
        if self.WORLD_KEY in observation_request:
            storage = message.world_data
            storage.SetInParent()
            self._required_world().get_data(observation_request[self.WORLD_KEY], storage)
        self.communication.put_message(message)

    def _configure(self, configuration_request: dict[str, Any]) -> None:
        """Hand the parts of a configuration to whom they are for.

        Args:
            configuration_request: Dictionary with any of the keys ``agent``, ``world`` and
                ``environment``; the last takes ``repeat_action`` and ``time_speed``.

        Raises:
            RequestError: A value is not what the environment takes; nothing is changed then.
        """
        own = configuration_request.get(self.ENVIRONMENT_KEY, {})
        values = as_object(f"{self.CONFIG_KEY}.{self.ENVIRONMENT_KEY}", own)
        repeat, speed = self._repeat_action, self.time_speed
        if self.REPEAT_ACTION_KEY in values:
            repeat = as_count(self.REPEAT_ACTION_KEY, values[self.REPEAT_ACTION_KEY])
        if self.TIME_SPEED_KEY in values:
            speed = as_speed(values[self.TIME_SPEED_KEY])
        if self.AGENT_KEY in configuration_request:
            self._required_agent().configure(configuration_request[self.AGENT_KEY])
        if self.WORLD_KEY in configuration_request:
            self._required_world().configure(configuration_request[self.WORLD_KEY])
        self.repeat_action, self.time_speed = repeat, speed

    def _seed(self, value: Any) -> None:
        """Take the value of a request to reset, and its seed if it has one."""
        if isinstance(value, dict) and value.get(self.SEED_KEY) is not None:
            self.rng = np.random.default_rng(as_seed(value[self.SEED_KEY]))
        self.reset_request = value

    # Stepping -------------------------------------------------------------------------------

    def _run(self, stepping: Stepping) -> Iterator[float]:
        """Do what `_step` says; yield how long to leave it alone, in s."""
        if stepping is None:
            return
        waits = stepping if isinstance(stepping, Generator) else stepping.__await__()
        try:
            for awaited in waits:
                if isinstance(awaited, PhysicsFramesTimer):
                    begin, frames = time.monotonic(), 0
                    while awaited.is_started:
                        frames, wait = self._frames(awaited, begin, frames)
                        if not awaited.is_started:
                            break
                        yield wait
                        if self.communication.is_abandoned:
                            raise RequestError("The client left in the middle of a step.")
                elif isinstance(awaited, (int, float)):
                    yield awaited
                else:
                    raise UsageError(f"_step() waits for {awaited!r}: no timer, no number of s.")
        finally:
            self.paused = True
            if isinstance(waits, Generator):
                waits.close()

    def _frames(self, timer: PhysicsFramesTimer, begin: float, frames: int) -> tuple[int, float]:
        """Let physics run until a timer ends, the pace says to wait, or others waited long enough.

        Args:
            timer: The timer.
            begin: When the step began, in monotonic s.
            frames: How many frames have passed since then.

        Returns:
            How many frames have passed by now, and how long to wait, in s.
        """
        turn = time.monotonic()
        steps, delta = self.frame_steps, self.frame_time
        while True:
            self._physics_process(delta)
            if timer is not self.physics_frames_timer:
                timer.step()
            if not timer.is_started:
                return frames, 0.0
            if not self.paused:
                self._frame(delta, steps)
            frames += 1
            now, wait = time.monotonic(), 0.0
            if self.time_speed is not None:
                wait = max(0.0, begin + frames * delta / self.time_speed - now)
            if wait or now - turn > _SLICE:
                return frames, wait

    def _frame(self, delta: float, steps: int) -> None:
        """Simulate one physics frame."""
        if self.agent is not None:
            self.agent._physics_process(delta)
        if self.world is not None:
            self.world._physics_process(delta)
        if self.simulation is not None:
            self.simulation.step(steps)

    # ----------------------------------------------------------------------------------------

    def _required_agent(self) -> RLAgent:
        if self.agent is None:
            raise UsageError("There is no agent: set self.agent in _ready().")
        return self.agent

    def _required_world(self) -> RLEnvWorld:
        if self.world is None:
            raise UsageError("There is no world: set self.world in _ready().")
        return self.world

    def _message(self) -> Any:
        if self.messages is None:
            raise UsageError(
                "There are no messages to answer with: set self.messages in _ready(), for example "
                "to Messages.of_fields(agent=[...], world=[...])."
            )
        return self.messages.Message()

    def _described(self) -> str:
        """Return what clients may want to know, as JSON."""
        spaces = {"observation": self.observation_space, "action": self.action_space}
        told = {name: describe_space(space) for name, space in spaces.items() if space is not None}
        messages = {} if self.messages is None else self.messages.to_dict()
        return json.dumps({"version": 1, "messages": messages, "spaces": told})
