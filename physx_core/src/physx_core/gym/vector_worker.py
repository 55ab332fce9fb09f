"""The part of a parallel vector environment that lives in a client."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from physx_core.errors import UsageError
from physx_core.fields import Array, Field, Sample
from physx_core.gym.making import make_env
from physx_core.gym.space_fields import SpaceFields
from physx_core.gym.vector_infos import columns_of, layout_of, numbers_of
from physx_core.interfaces.environment import Environment
from physx_core.transport.values import decode, encode

COMMAND = "command"
"""Entry of a prediction that is no action but says what else to do."""
INFOS = "infos"
"""Field of the infos as bytes, after their length."""
FORBIDDEN = ("reset", "step", "close")
"""Methods that `call` does not call."""
_LENGTH = 8
_INFO_BYTES = 512
"""Bytes of a row for the infos of each environment; longer ones go by another way."""


class VectorWorker(Environment):
    """Steps some of a vector environment's environments; a row holds one step of all of them.

    An action, or a command, comes as the prediction; the next row is what became of it. What has no
    fixed shape, infos and returned values, goes by `save_parameters` before the row; infos that
    are short go as bytes within the row, without waiting for an answer.
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
        """Keep what the environments are made from.

        Args:
            env: See `physx_core.gym.making.make_env`.
            num_envs: Number of the vector environment's environments.
            share: How many of them one client has; the last client may have fewer.
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
        self._layout: list[Any] = []  # of the infos that were sent last

    def create(self) -> None:
        """Make the environments."""
        self._envs = [make_env(self._name, self._options) for _ in range(self._count)]
        self._actions = SpaceFields(self._envs[0].action_space, "action")
        self._observations = SpaceFields(self._envs[0].observation_space, "observation")
        self._over = np.zeros(self._share, np.bool_)

    def init_database(self) -> None:
        """Define the fields: each has a leading axis of the client's environments."""
        fields = [
            *self._observations.fields,
            Field("reward", ()),
            Field("terminated", (), "bool"),
            Field("truncated", (), "bool"),
        ]
        if self._mode is AutoresetMode.SAME_STEP:
            fields += [
                Field(f"final_{field.name}", field.shape, field.dtype)
                for field in self._observations.fields
            ]
        wide = [Field(f.name, (self._share, *(f.shape or ())), f.dtype) for f in fields]
        wide.append(Field(INFOS, (_LENGTH + self._share * _INFO_BYTES,), "uint8"))
        self._row = {f.name: np.zeros(f.shape or (), f.dtype) for f in wide}
        self.define_training_fields(wide)

    def apply_prediction(self, prediction: Sample) -> None:
        """Keep the actions or the command for the next step."""
        self._command = prediction

    def step(self) -> None:
        """Do what the last prediction asked for."""
        command, self._command = self._command, None
        self._row[INFOS][:_LENGTH] = 0
        if command is not None and COMMAND in command:
            self._obey(unpacked(command[COMMAND]))
        elif command is not None:
            self._advance(command)
        self.set_training_data(**self._row)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    # Steps ----------------------------------------------------------------------------------

    def _advance(self, actions: Mapping[str, Any]) -> None:
        infos: list[dict[str, Any]] = []
        row = self._row
        for place, env in enumerate(self._envs):
            if self._mode is AutoresetMode.NEXT_STEP and self._over[place]:
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
            self._over[place] = over
            self._put(place, observation)
            infos.append(info)
        self._tell(infos)

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
        self._over[place] = False
        return info

    # Commands -------------------------------------------------------------------------------

    def _obey(self, command: Mapping[str, Any]) -> None:
        arguments = command["arguments"]
        if command["name"] == "reset":
            infos = [
                self._reset(i, arguments["seeds"][i], arguments["options"])
                if arguments["mask"][i]
                else {}
                for i in range(self._count)
            ]
            self._tell(infos)
        elif command["name"] == "call":
            name, positional, named = arguments
            results = [_called(env, name, positional, named) for env in self._envs]
            self.save_parameters(results=results)
        else:
            name, values = arguments
            for env, value in zip(self._envs, values, strict=False):
                env.set_wrapper_attr(name, value)

    def _tell(self, infos: Sequence[dict[str, Any]]) -> None:
        """Send the infos, if there is anything in them; what cannot travel is named instead."""
        if not any(infos):
            return
        named = [{str(name): value for name, value in info.items()} for info in infos]
        columns = columns_of(named)
        if columns is not None and self._tell_numbers(columns):
            return
        said: dict[str, Any] = {"columns": columns} if columns else {"infos": named}
        try:
            text = encode(said, "infos")
        except UsageError:
            left_out: set[str] = set()
            said = {"infos": [_plain(info, left_out) for info in infos]}
            said["left_out"] = sorted(left_out)
            text = encode(said, "infos")
        if _LENGTH + len(text) <= self._row[INFOS].size:
            _put_text(self._row[INFOS], text)
        else:
            self.save_parameters(**said)

    def _tell_numbers(self, columns: dict[str, Any]) -> bool:
        """Send the numbers alone, if they are of the layout that was sent last."""
        known, self._layout = self._layout, layout_of(columns)
        numbers = numbers_of(columns)
        if known != self._layout or _LENGTH + len(numbers) > self._row[INFOS].size:
            return False
        _put_text(self._row[INFOS], numbers, are_numbers=True)
        return True


def _called(
    env: gymnasium.Env[Any, Any], name: str, positional: Sequence[Any], named: Mapping[str, Any]
) -> Any:
    attribute = env.get_wrapper_attr(name)
    result = attribute(*positional, **named) if callable(attribute) else attribute
    try:
        encode(result, name)
    except UsageError as error:
        raise UsageError(f'"{name}" of the environments cannot be sent: {error}') from error
    return result


def _plain(info: Mapping[str, Any], left_out: set[str]) -> dict[str, Any]:
    """Return what of an info can travel; add the names of the rest to `left_out`."""
    found: dict[str, Any] = {}
    for name, value in info.items():
        try:
            encode({"": value} if isinstance(value, dict) else value, str(name))
        except UsageError:
            left_out.add(str(name))
            continue
        found[str(name)] = value
    return found


def packed(name: str, arguments: Sequence[Any]) -> Array:
    """Return a command for each client, as bytes of one length, shape (clients, bytes)."""
    texts = [encode({"name": name, "arguments": each}, name) for each in arguments]
    rows = np.zeros((len(texts), _LENGTH + max(map(len, texts))), np.uint8)
    for row, text in zip(rows, texts, strict=True):
        _put_text(row, text)
    return rows


def _put_text(row: Array, text: bytes, *, are_numbers: bool = False) -> None:
    """Write bytes to the begin of a row, after their length, which is negative for numbers."""
    length = -len(text) if are_numbers else len(text)
    whole = length.to_bytes(_LENGTH, "little", signed=True) + text
    row[: len(whole)] = np.frombuffer(whole, np.uint8)


def unpacked(row: Array) -> Any:
    """Return the command of one client, or what a client says in a row; None: nothing.

    Numbers of `numbers_of` are returned as they are, as bytes.
    """
    length = int.from_bytes(row[:_LENGTH].tobytes(), "little", signed=True)
    text = row[_LENGTH : _LENGTH + abs(length)].tobytes()
    return decode(text) if length > 0 else text if length < 0 else None
