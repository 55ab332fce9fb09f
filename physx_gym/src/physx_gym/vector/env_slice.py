"""EnvSlice: the environments that one worker steps."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import gymnasium
from gymnasium.vector import AutoresetMode

from physx_core.errors import ConfigError, EnvironmentFailedError, PhysxError, UsageError, own_line
from physx_core.net import Kind, encode, encode_error
from physx_core.typing import Array
from physx_gym.bridge.make_env import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.batch import EnvArrays
from physx_gym.vector.infos import InfoKind, InfoLayout, put_packed

_MOST_LAYOUTS = 100
_FRESH = (None, None)
_NO_INFO = int(InfoKind.NONE)


class EnvSlice:
    """Some of a vector environment's environments; their results go into its arrays."""

    def __init__(
        self, setup: Mapping[str, Any], batch: EnvArrays, send: Callable[[Kind, bytes, int], None]
    ) -> None:
        """Store what to run; `create` creates the environments.

        Args:
            setup: What the worker received.
            batch: Arrays of these environments, and perhaps of others.
            send: Sends a message to the process with the vector environment: kind, content, number.
        """
        shares, number = setup["shares"], setup["number"]
        self._count, self._first = shares[number], sum(shares[:number])
        self._setup, self._send = setup, send
        self._mode = AutoresetMode(setup["autoreset"])
        first = self._first - batch.first
        mine = slice(first, first + self._count)
        self._infos = batch.infos[mine]
        # A memoryview writes a number in half the time an array takes.
        self._rewards, self._terminated, self._truncated, self._kinds = (
            memoryview(cast(Any, array[mine]))
            for array in (batch.rewards, batch.terminated, batch.truncated, batch.kinds)
        )
        self._given, self._seen, self._finals = (
            {name: array[mine] for name, array in arrays.items()}
            for arrays in (batch.actions, batch.observations, batch.finals)
        )
        self._envs: list[gymnasium.Env[Any, Any]] = []
        # Seed and options of each environment whose next step is a reset.
        self._due: list[tuple[int | None, dict[str, Any] | None] | None] = [None] * self._count
        self._steps = [0] * self._count
        self._layouts: dict[str, int] = {}
        self._layout: InfoLayout | None = None  # the one used last, and its number
        self._layout_number = 0
        self._left_out: set[str] = set()

    def create(self) -> None:
        """Create the environments."""
        for place in range(self._count):
            if not self._attempt("__init__", place, self._make):
                return

    def step(self, place: int) -> None:
        """Step an environment, or reset it if that is due."""
        is_due = self._due[place] is not None
        try:
            if is_due:
                self._reset(place)
            else:
                self._step(place)
        except Exception as error:
            self._report(error, "reset" if is_due else "step", place)

    def execute(self, command: Mapping[str, Any]) -> None:
        """Execute a command: prepare resets, call a method of each environment, or set a value."""
        name, arguments = command["name"], command["arguments"]
        if name == "reset":
            options = arguments["options"]
            for place, seed in zip(arguments["places"], arguments["seeds"], strict=True):
                self._due[place] = (seed, None if options is None else dict(options))
        elif name == "call":
            results: list[Any] = []

            def call(place: int) -> None:
                results.append(_call(self._envs[place], *arguments))

            if all(self._attempt(arguments[0], place, call) for place in range(self._count)):
                self._send(Kind.ANSWER, encode(results), 0)
        else:
            name, values = arguments

            def assign(place: int) -> None:
                self._envs[place].set_wrapper_attr(name, values[place])

            for place in range(self._count):
                self._attempt(f"set_wrapper_attr({name!r})", place, assign)

    def close(self) -> None:
        """Close the environments."""
        for place in range(len(self._envs)):
            self._attempt("close", place, lambda place: self._envs[place].close())

    def _attempt(self, method: str, place: int, function: Callable[[int], None]) -> bool:
        """Call a function for an environment; return whether it succeeded; if not, send why."""
        try:
            function(place)
        except Exception as error:
            self._report(error, method, place)
            return False
        return True

    def _report(self, error: Exception, method: str, place: int) -> None:
        env = self._first + place
        known = error if isinstance(error, PhysxError) else self._wrap(error, method, place)
        known.add_note(f"in {method}() of environment {env} of the vector environment (from 0)")
        self._send(Kind.ERROR, encode_error(known), env)

    def _wrap(self, error: Exception, method: str, place: int) -> EnvironmentFailedError:
        step = self._steps[place] - 1 if method == "step" else -1
        summary = "".join(traceback.format_exception_only(error)).strip()
        if line := own_line(error):
            summary += f" ({line})"
        text = "".join(traceback.format_exception(error))
        return EnvironmentFailedError(self._first + place + 1, method, step, summary, text)

    # Steps ----------------------------------------------------------------------------------

    def _make(self, place: int) -> None:
        setup = self._setup
        env = make_env(setup["env"], setup["options"])
        self._envs.append(env)
        self._actions = SpaceFields(env.action_space, "action")
        self._observations = SpaceFields(env.observation_space, "observation")
        for name, space in (("actions", self._actions), ("observations", self._observations)):
            if [field.to_dict() for field in space.fields] != setup[name]:
                raise ConfigError(
                    f"The {name} of this environment, {space.space}, differ in shape or type from "
                    "those of another one that was created with the same arguments. In a vector "
                    "environment, they must be the same in all."
                )

    def _step(self, place: int) -> None:
        env, action = self._envs[place], self._actions.copy(self._given, place)
        self._steps[place] += 1
        observation, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            if self._mode is AutoresetMode.NEXT_STEP:
                self._due[place] = _FRESH
            elif self._mode is AutoresetMode.SAME_STEP:
                self._observations.put(self._finals, place, observation)
                observation, reset_info = env.reset()
                info = {**reset_info, "final_info": info}
        self._put(place, observation, reward, terminated, truncated)
        self._put_info(place, info)

    def _reset(self, place: int) -> None:
        seed, options = self._due[place] or _FRESH
        self._due[place] = None
        observation, info = self._envs[place].reset(seed=seed, options=options)
        self._put(place, observation, 0.0, False, False)
        self._put_info(place, info)

    def _put(
        self, place: int, observation: Any, reward: Any, terminated: Any, truncated: Any
    ) -> None:
        self._observations.put(self._seen, place, observation)
        self._rewards[place] = reward
        self._terminated[place], self._truncated[place] = terminated, truncated

    def _put_info(self, place: int, info: Mapping[str, Any]) -> None:
        """Write an info; of entries that cannot be sent, only the names are sent."""
        if not info:
            self._kinds[place] = _NO_INFO
            return
        target: Array = self._infos[place]
        if self._layout is not None and self._layout.put(info, target):
            self._kinds[place] = self._layout_number
        else:
            plain = {str(name): value for name, value in info.items()}
            if self._learn(plain) and self._layout is not None and self._layout.put(plain, target):
                self._kinds[place] = self._layout_number
            else:
                self._pack_info(place, plain)

    def _learn(self, info: Mapping[str, Any]) -> bool:
        """Find the layout of an info, and send it if it is new; return whether it has one."""
        layout = InfoLayout.of(info)
        if layout is None:
            return False
        number = self._layouts.get(str(layout.names), len(self._layouts) + 1)
        if number > _MOST_LAYOUTS:
            return False
        if number > len(self._layouts):
            self._layouts[str(layout.names)] = number
            self._send(Kind.FIELDS, encode(layout.names), number)
        self._layout, self._layout_number = layout, number
        return True

    def _pack_info(self, place: int, info: dict[str, Any]) -> None:
        """Write an info of any kind; send it if it does not fit or entries are left out."""
        left_out: list[str] = []
        try:
            encoded = encode(info)
        except UsageError:
            sent = {name: value for name, value in info.items() if _is_sendable(value)}
            left_out = sorted(info.keys() - sent.keys() - self._left_out)
            self._left_out |= set(left_out)
            info, encoded = sent, encode(sent)
        if not left_out and put_packed(self._infos[place], encoded):
            self._kinds[place] = InfoKind.PACKED
        else:
            self._kinds[place] = InfoKind.SENT
            message = encode({"info": info, "left_out": left_out})
            self._send(Kind.NOTES, message, self._first + place)


def _call(
    env: gymnasium.Env[Any, Any], name: str, positional: Sequence[Any], named: Mapping[str, Any]
) -> Any:
    attribute = env.get_wrapper_attr(name)
    result = attribute(*positional, **named) if callable(attribute) else attribute
    try:
        encode(result, name)
    except UsageError as error:
        raise UsageError(f'"{name}" of the environments cannot be sent: {error}') from error
    return result


def _is_sendable(value: Any) -> bool:
    try:
        encode({"": value} if isinstance(value, dict) else value, "info")
    except UsageError:
        return False
    return True
