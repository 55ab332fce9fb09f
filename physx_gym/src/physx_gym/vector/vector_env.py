"""Several environments in several processes, stepped together."""

from __future__ import annotations

import contextlib
import itertools
import logging
import operator
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from physx_core import EnvironmentConfig
from physx_core.components import Event
from physx_core.config import reference_of
from physx_core.errors import ActionError, ConfigError, UnknownOptionError, UsageError
from physx_core.sources import ClientSource
from physx_core.typing import Array, Batch, Sample
from physx_gym.bridge.making import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.infos import InfoLayout
from physx_gym.vector.rows import ROW, Info, RowLayout, text_value
from physx_gym.vector.worker import COMMAND, FORBIDDEN, VectorWorker, packed

_LOG = logging.getLogger("physx")


class ParallelVectorEnv(VectorEnv[Any, Any, Any]):
    """A vector environment whose environments are stepped in client processes.

    ``gymnasium.make_vec("physx/Ant-v0", num_envs=4)`` makes one. It does what Gymnasium's
    `AsyncVectorEnv` does, with the clients of a data generation: spawned, authenticated, watched,
    and ended in every case. An environment that raises is named with its traceback.

    Infos come back as far as they are plain values and arrays; a warning names those that are not.
    """

    def __init__(
        self,
        env: str | type[Any],
        num_envs: int = 1,
        *,
        env_kwargs: Mapping[str, Any] | None = None,
        processes: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        timeout: float = 60.0,
    ) -> None:
        """Start the processes.

        Args:
            env: Id of the environment, ``"package.module:Class"``, ``"script.py:Class"``, or the
                class.
            num_envs: How many environments.
            env_kwargs: Keyword arguments of each.
            processes: How many processes share the environments; None: as many as there are
                processors, but no more than environments.
            autoreset_mode: What happens after the end of an episode.
            copy: Whether observations are copies; otherwise they are valid until the next call.
            timeout: How long a step may take, in s.

        Raises:
            ConfigError: A value cannot be, or a space holds values without a fixed shape.
            PhysxError: An environment or a process failed.
        """
        if num_envs < 1 or (processes is not None and processes < 1):
            raise ConfigError("num_envs and processes must be at least 1.")
        if not isinstance(env_kwargs or {}, Mapping):
            raise ConfigError(f"env_kwargs is {env_kwargs!r} but must be a dictionary.")
        modes = {each.value: each for each in AutoresetMode}
        if not isinstance(autoreset_mode, AutoresetMode) and autoreset_mode not in modes:
            raise UnknownOptionError("autoreset_mode", [str(autoreset_mode)], modes)
        name, options = reference_of(env), dict(env_kwargs or {})
        mode = AutoresetMode(autoreset_mode)
        self.num_envs = num_envs
        self._describe(name, options, mode)
        share = -(-num_envs // min(processes or len(os.sched_getaffinity(0)), num_envs))
        self._share, self._copy = share, copy
        has_finals = mode is AutoresetMode.SAME_STEP
        self._row = RowLayout(self._observations, share, has_finals=has_finals)
        self._notes = _Notes()
        config = EnvironmentConfig(
            VectorWorker,
            num_clients=-(-num_envs // share),
            timeout=timeout,
            env_kwargs={
                "env": name,
                "num_envs": num_envs,
                "share": share,
                "make_kwargs": options,
                "autoreset": mode.value,
            },
        )
        self._clients = config.num_clients
        source = ClientSource(config, self._notes, [0], run_ahead=0)
        self._source: ClientSource | None = source
        with contextlib.ExitStack() as stack:
            stack.enter_context(source)
            self._answer()
            stack.pop_all()

    def _describe(self, name: str, options: Mapping[str, Any], mode: AutoresetMode) -> None:
        with_spaces = make_env(name, options)
        self.single_observation_space = with_spaces.observation_space
        self.single_action_space = with_spaces.action_space
        self.metadata = {**with_spaces.metadata, "autoreset_mode": mode}
        self.render_mode = with_spaces.render_mode
        self.spec = with_spaces.spec
        with_spaces.close()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._mode = mode
        self._observations = SpaceFields(self.single_observation_space, "observation")
        self._actions = SpaceFields(self.single_action_space, "action")

    # Stepping -------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes; return observations and infos.

        Args:
            seed: Environment i gets ``seed + i``; or a seed for each.
            options: Handed to each environment's `reset`, except for ``reset_mask``, shape
                (num_envs,): which environments are reset, where the mode is `DISABLED`.

        Raises:
            ConfigError: The number of seeds, or the mask, does not fit.
        """
        count = self.num_envs
        seeds: list[int | None] = [None] * count
        try:
            if seed is not None:
                each = range(seed, seed + count) if isinstance(seed, int) else seed
                seeds = [None if one is None else operator.index(one) for one in each]
        except TypeError as error:
            raise ConfigError(f"The seeds are {seed!r} but must be whole numbers.") from error
        options = dict(options or {})
        mask = np.ones(count, np.bool_)
        if "reset_mask" in options:
            mask = np.asarray(options.pop("reset_mask"))
        if len(seeds) != count or mask.shape != (count,) or mask.dtype != np.bool_:
            raise ConfigError(
                f"reset() of {count} environments got {len(seeds)} seeds, and a mask of shape "
                f"{mask.shape} and type {mask.dtype}: give one seed and one bool for each."
            )
        if not mask.any():
            raise ConfigError("reset_mask resets no environment.")
        rest = options or None
        self._command(
            "reset",
            [
                {"seeds": s, "mask": m, "options": rest}
                for s, m in zip(self._shared(seeds), self._shared(mask.tolist()), strict=True)
            ],
        )
        records = self._answer()
        return self._observed(records), self._infos(records, {})

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step all environments.

        Args:
            actions: A batch of actions: see `action_space`.

        Returns:
            Observations, rewards, terminations, truncations, each with a leading axis of
            environments, and infos.

        Raises:
            ActionError: The actions are not of the space's shape.
            PhysxError: An environment raised, or a process failed.
        """
        self._open().apply(self._shares_of(actions), at_once=False)
        records = self._answer()
        terminated, truncated = records["terminated"].copy(), records["truncated"].copy()
        finals: dict[int, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP:
            names = [field.name for field in self._observations.fields]
            for i in np.flatnonzero(terminated | truncated).tolist():
                arrays = {name: records[f"final_{name}"][i].copy() for name in names}
                finals[i] = self._observations.value(arrays)
        infos = self._infos(records, finals)
        return self._observed(records), records["reward"].copy(), terminated, truncated, infos

    def _shares_of(self, actions: Any) -> Batch:
        """Return the actions by client: arrays of shape (clients, share, *shape)."""
        shares: Batch = {}
        try:
            given = self._actions.arrays(actions)
        except (TypeError, ValueError, LookupError) as error:
            raise ActionError(f"These are no actions of {self.action_space}: {error}.") from error
        for field in self._actions.fields:
            wanted = (self.num_envs, *(field.shape or ()))
            array = given[field.name]
            if array.shape != wanted:
                raise ActionError(
                    f"The actions have the shape {array.shape} but need {wanted}: one action of "
                    f"{self.single_action_space} for each environment."
                )
            padding = self._clients * self._share - self.num_envs
            if padding:
                array = np.concatenate([array, np.repeat(array[-1:], padding, axis=0)])
            shares[field.name] = array.reshape(self._clients, self._share, *wanted[1:])
        return shares

    def _answer(self) -> Array:
        """Return what became of the last actions or commands, as records, shape (num_envs,)."""
        return self._row.records(self._open().batch(self._clients)[ROW])[: self.num_envs]

    def _observed(self, records: Array) -> Any:
        names = [field.name for field in self._observations.fields]
        return self._observations.batch(
            {name: records[name].copy() if self._copy else records[name] for name in names}
        )

    def _infos(self, records: Array, finals: Mapping[int, Any]) -> dict[str, Any]:
        kinds, data = records["info"], records["infos"]
        layout = self._notes.layout
        found = kinds.tobytes()
        if Info.TEXT not in found and not finals:
            if Info.NUMBERS not in found:
                return {}
            if layout is not None:
                return layout.columns(layout.records(data), kinds == Info.NUMBERS)
        infos: dict[str, Any] = {}
        told: list[tuple[int, dict[str, Any]]] = []
        for i, kind in enumerate(kinds.tolist()):
            client, place = divmod(i, self._share)
            info: dict[str, Any] = {}
            if kind == Info.NUMBERS:
                info = self._notes.info(client, data[i])
            elif kind == Info.TEXT:
                said = text_value(data[i]) or self._notes.said(client)["infos"][str(place)]
                told.append((client, said))
                info = said["info"]
            if i in finals:
                info = {"final_obs": finals[i], **info}
            if info:
                infos = self._add_info(infos, info, i)
        for client, said in told:  # from the next row on
            self._notes.learn(client, said)
        return infos

    # Everything else ------------------------------------------------------------------------

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute; return what each gives.

        Raises:
            UsageError: It is `reset`, `step` or `close`, or what it gives cannot be sent.
        """
        if name in FORBIDDEN:
            raise UsageError(f'call("{name}") would go past this object: use {name}() itself.')
        self._command("call", [(name, list(args), kwargs)] * self._clients)
        self._answer()
        results = [self._notes.said(client)["results"] for client in range(self._clients)]
        return tuple(itertools.chain.from_iterable(results))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each environment: one value for all, or a list with one for each.

        Raises:
            ConfigError: There are more or fewer values than environments.
        """
        each = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ConfigError(f"{len(each)} values for {self.num_envs} environments.")
        self._command("set", [(name, share) for share in self._shared(each)])
        self._answer()

    def render(self) -> tuple[Any, ...]:
        """Return what each environment renders."""
        return self.call("render")

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        source, self._source = getattr(self, "_source", None), None
        if source is not None:
            source.close()

    def _open(self) -> ClientSource:
        if self._source is None:
            raise UsageError("This vector environment is closed.")
        return self._source

    def _command(self, name: str, arguments: Sequence[Any]) -> None:
        """Have each client obey a command in the place of actions."""
        self._open().apply({COMMAND: packed(name, arguments)}, at_once=False)

    def _shared(self, values: Sequence[Any]) -> list[list[Any]]:
        """Return the values of each client's environments."""
        return [
            list(values[first : first + self._share])
            for first in range(0, self.num_envs, self._share)
        ]


class _Notes:
    """What clients say beside their rows; the services of the run that they think they are in.

    Attributes:
        layout: Layout of the infos of all clients that told one; None where they differ.
    """

    def __init__(self) -> None:
        self.layout: InfoLayout | None = None
        self._said: dict[int, dict[str, Any]] = {}
        self._layouts: dict[int, InfoLayout] = {}
        self._left_out: set[str] = set()

    def said(self, client: int) -> dict[str, Any]:
        """Return what a client, counted from 0, said before its last row."""
        return self._said[client]

    def info(self, client: int, data: Array) -> dict[str, Any]:
        """Return an info that is a record of the layout that a client told last."""
        layout = self._layouts[client]
        return layout.info(layout.records(data[np.newaxis])[0])

    def learn(self, client: int, said: Mapping[str, Any]) -> None:
        """Note the layout that was told with an info; warn of what was left out."""
        if "layout" in said:
            self._layouts[client] = layout = InfoLayout(said["layout"])
            differ = any(other.names != layout.names for other in self._layouts.values())
            self.layout = None if differ else layout
        new = set(said.get("left_out", [])) - self._left_out
        if new:
            self._left_out |= new
            _LOG.warning(
                "Infos of these names are left out, for they hold more than plain values and "
                "arrays: %s.",
                ", ".join(sorted(new)),
            )

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep what a client says before its row."""
        self._said[instance_id - 1] = values

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return nothing: workers do not ask."""
        return {}

    def predict(self, fields: Sample) -> Sample:
        """Refuse: workers do not ask."""
        raise UsageError("A vector environment has no network.")

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Do nothing: workers do not draw."""
