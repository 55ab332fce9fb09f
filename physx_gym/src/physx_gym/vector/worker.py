"""The part of a parallel vector environment that lives in a client."""

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
from physx_gym.bridge.making import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.infos import InfoLayout
from physx_gym.vector.rows import LENGTH, ROW, Info, RowLayout, put_text, text_value

COMMAND = "command"
"""Entry of a prediction that is no action but says what else to do."""
FORBIDDEN = ("reset", "step", "close")
"""Methods that `call` does not call."""


class VectorWorker(Environment):
    """Steps some of a vector environment's environments; a row holds one step of all of them.

    An action, or a command, comes as the prediction; the next row is what became of it: see
    `RowLayout`. Infos that are too long for it, and what methods return, go by `save_parameters`
    before the row, which waits for an answer.
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
            env: See `physx_gym.bridge.making.make_env`.
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
        self._layout: InfoLayout | None = None  # of infos, that was told last

    def create(self) -> None:
        """Make the environments."""
        self._envs = [make_env(self._name, self._options) for _ in range(self._count)]
        self._actions = SpaceFields(self._envs[0].action_space, "action")
        self._observations = SpaceFields(self._envs[0].observation_space, "observation")
        self._over = np.zeros(self._share, np.bool_)

    def init_database(self) -> None:
        """Define the row."""
        has_finals = self._mode is AutoresetMode.SAME_STEP
        layout = RowLayout(self._observations, self._share, has_finals=has_finals)
        records = np.zeros(self._share, layout.dtype)
        self._row = {name: records[name] for name in layout.dtype.names or ()}
        self._bytes = records.view(np.uint8)
        self.define_training_fields([layout.field])

    def apply_prediction(self, prediction: Sample) -> None:
        """Keep the actions or the command for the next step."""
        self._command = prediction

    def step(self) -> None:
        """Do what the last prediction asked for."""
        command, self._command = self._command, None
        if command is not None and COMMAND in command:
            self._obey(text_value(command[COMMAND]))
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
        known, long = self._layout, {}
        for place, info in enumerate(infos):
            target = self._row["infos"][place]
            if not info:
                self._row["info"][place] = Info.NONE
            elif known is not None and known.put(info, target):
                self._row["info"][place] = Info.NUMBERS
            else:
                self._row["info"][place] = Info.TEXT
                said, text = self._said(info)
                is_long = LENGTH + len(text) > len(target)
                put_text(target, b"" if is_long else text)
                if is_long:
                    long[str(place)] = said
        if long:
            self.save_parameters(infos=long)

    def _said(self, info: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Return an info as a value and as a text, with its layout, which the next may have."""
        said: dict[str, Any] = {"info": {str(name): value for name, value in info.items()}}
        layout = InfoLayout.of(said["info"])
        if layout is not None:
            self._layout, said["layout"] = layout, layout.names
        try:
            return said, encode(said, "infos")
        except UsageError:
            left_out: set[str] = set()
            said["info"] = _plain(said["info"], left_out)
            said["left_out"] = sorted(left_out)
            return said, encode(said, "infos")


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
    rows = np.zeros((len(texts), LENGTH + max(map(len, texts))), np.uint8)
    for row, text in zip(rows, texts, strict=True):
        put_text(row, text)
    return rows
