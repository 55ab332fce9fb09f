"""Worker of a parallel vector environment: steps a share of the environments in a client."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from physx_core.components import Environment
from physx_core.errors import UsageError
from physx_core.net import encode
from physx_core.typing import Array, Sample
from physx_gym.bridge.make_env import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.infos import InfoLayout
from physx_gym.vector.rows import LENGTH, ROW, InfoKind, RowLayout, put_packed, unpack

COMMAND = "command"
"""Entry of a prediction that holds a command instead of actions."""
FORBIDDEN = ("reset", "step", "close")
"""Methods that `call` rejects."""


class VectorWorker(Environment):
    """Steps some of a vector environment's environments; a row holds one step of all of them.

    Actions, or a command, arrive as the prediction; the next row is their result: see `RowLayout`.
    Infos that do not fit, and results of methods, are sent through `save_parameters` before the
    row; that call waits for an answer.
    """

    def __init__(
        self,
        *,
        env: str,
        num_envs: int,
        share: int,
        make_kwargs: Mapping[str, Any],
        autoreset: str,
        **kwargs: Any,
    ) -> None:
        """Store the arguments of the environments.

        Args:
            env: See `physx_gym.bridge.make_env.make_env`.
            num_envs: Number of environments of the whole vector environment.
            share: Number of environments of each client; the last one may have fewer.
            make_kwargs: Keyword arguments of each environment.
            autoreset: Value of an `AutoresetMode`.
            kwargs: Those of `Environment`.
        """
        super().__init__(**kwargs)
        first = (self.instance_id - 1) * share
        self._count = min(share, num_envs - first)
        self._share = share
        self._name, self._options = env, dict(make_kwargs)
        self._mode = AutoresetMode(autoreset)
        self._envs: list[gymnasium.Env[Any, Any]] = []
        self._command: Mapping[str, Any] | None = None
        self._layout: InfoLayout | None = None  # the one announced last

    def create(self) -> None:
        """Create the environments."""
        self._envs = [make_env(self._name, self._options) for _ in range(self._count)]
        self._actions = SpaceFields(self._envs[0].action_space, "action")
        self._observations = SpaceFields(self._envs[0].observation_space, "observation")
        self._is_over = np.zeros(self._share, np.bool_)

    def init_database(self) -> None:
        """Define the row."""
        has_finals = self._mode is AutoresetMode.SAME_STEP
        layout = RowLayout(self._observations, self._share, has_finals=has_finals)
        records = np.zeros(self._share, layout.dtype)
        self._row = {name: records[name] for name in layout.dtype.names or ()}
        self._bytes = records.view(np.uint8)
        self.define_training_fields([layout.field])

    def apply_prediction(self, prediction: Sample) -> None:
        """Store the actions or the command for the next step."""
        self._command = prediction

    def step(self) -> None:
        """Execute what the last prediction asked for."""
        command, self._command = self._command, None
        if command is not None and COMMAND in command:
            self._execute(unpack(command[COMMAND]))
        elif command is not None:
            self._advance(command)
        self.set_training_data(**{ROW: self._bytes})

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    # Steps ----------------------------------------------------------------------------------

    def _advance(self, actions: Mapping[str, Any]) -> None:
        infos: list[dict[str, Any]] = []
        row = self._row
        for place, env in enumerate(self._envs):
            if self._mode is AutoresetMode.NEXT_STEP and self._is_over[place]:
                infos.append(self._reset(place, None, None))
                continue
            action = self._actions.value({name: each[place] for name, each in actions.items()})
            observation, reward, terminated, truncated, info = env.step(action)
            over = bool(terminated or truncated)
            row["reward"][place] = reward
            row["terminated"][place], row["truncated"][place] = terminated, truncated
            if over and self._mode is AutoresetMode.SAME_STEP:
                for name, value in self._observations.arrays(observation).items():
                    row[f"final_{name}"][place] = value
                observation, reset_info = env.reset()
                info = {**reset_info, "final_info": info}
            self._is_over[place] = over
            self._put(place, observation)
            infos.append(info)
        self._put_infos(infos)

    def _put(self, place: int, observation: Any) -> None:
        for name, value in self._observations.arrays(observation).items():
            self._row[name][place] = value

    def _reset(
        self, place: int, seed: int | None, options: dict[str, Any] | None
    ) -> dict[str, Any]:
        observation, info = self._envs[place].reset(seed=seed, options=options)
        self._put(place, observation)
        self._row["reward"][place] = 0.0
        self._row["terminated"][place] = self._row["truncated"][place] = False
        self._is_over[place] = False
        return info

    # Commands -------------------------------------------------------------------------------

    def _execute(self, command: Mapping[str, Any]) -> None:
        arguments = command["arguments"]
        if command["name"] == "reset":
            infos = [
                self._reset(i, arguments["seeds"][i], arguments["options"])
                if arguments["mask"][i]
                else {}
                for i in range(self._count)
            ]
            self._put_infos(infos)
        elif command["name"] == "call":
            name, positional, named = arguments
            results = [_call(env, name, positional, named) for env in self._envs]
            self.save_parameters(results=results)
        else:
            name, values = arguments
            for env, value in zip(self._envs, values, strict=False):
                env.set_wrapper_attr(name, value)

    def _put_infos(self, infos: Sequence[dict[str, Any]]) -> None:
        """Write the infos into the row; entries that cannot be sent are only named."""
        layout, long = self._layout, {}
        for place, info in enumerate(infos):
            target = self._row["infos"][place]
            if not info:
                self._row["info"][place] = InfoKind.NONE
            elif layout is not None and layout.put(info, target):
                self._row["info"][place] = InfoKind.NUMBERS
            else:
                self._row["info"][place] = InfoKind.PACKED
                report, encoded = self._report(info)
                is_long = LENGTH + len(encoded) > len(target)
                put_packed(target, b"" if is_long else encoded)
                if is_long:
                    long[str(place)] = report
        if long:
            self.save_parameters(infos=long)

    def _report(self, info: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Return an info with its layout, which later ones may share; as it is, and encoded."""
        report: dict[str, Any] = {"info": {str(name): value for name, value in info.items()}}
        layout = InfoLayout.of(report["info"])
        if layout is not None:
            self._layout, report["layout"] = layout, layout.names
        try:
            return report, encode(report, "infos")
        except UsageError:
            sent = {name: value for name, value in report["info"].items() if _is_sendable(value)}
            report["left_out"] = sorted(report["info"].keys() - sent.keys())
            report["info"] = sent
            return report, encode(report, "infos")


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


def pack_commands(name: str, arguments: Sequence[Any]) -> Array:
    """Return a command for each client, as bytes of one length, shape (clients, bytes)."""
    commands = [encode({"name": name, "arguments": each}, name) for each in arguments]
    rows = np.zeros((len(commands), LENGTH + max(map(len, commands))), np.uint8)
    for row, command in zip(rows, commands, strict=True):
        put_packed(row, command)
    return rows
