"""Vector environment whose environments run in several processes."""

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
from physx_gym.bridge.make_env import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.infos import InfoLayout
from physx_gym.vector.rows import ROW, InfoKind, RowLayout, unpack
from physx_gym.vector.worker import COMMAND, FORBIDDEN, VectorWorker, pack_commands

_LOG = logging.getLogger("physx")


class ParallelVectorEnv(VectorEnv[Any, Any, Any]):
    """A vector environment whose environments are stepped in client processes.

    ``gymnasium.make_vec("physx/Ant-v0", num_envs=4)`` creates one. It does what Gymnasium's
    `AsyncVectorEnv` does, with clients like those of a data generation: they are spawned,
    authenticated and monitored, and always end with it. If an environment raises, the error has
    its traceback.

    Infos may hold plain values and arrays; others are left out, and a warning names them.
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
            num_envs: Number of environments.
            env_kwargs: Keyword arguments of each environment.
            processes: Number of processes that share the environments; None: one for each
                processor, but no more than environments.
            autoreset_mode: What happens after the end of an episode.
            copy: Whether observations are copies; otherwise they are valid until the next call.
            timeout: Longest duration of a step, in s.

        Raises:
            ConfigError: If a value is out of range, or values of a space do not have a fixed shape.
            UnknownOptionError: If the autoreset mode is unknown.
            PhysxError: If an environment or a process fails.
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
        self._reports = _Reports()
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
        source = ClientSource(config, self._reports, [0], run_ahead=0)
        self._source: ClientSource | None = source
        with contextlib.ExitStack() as stack:
            stack.enter_context(source)
            self._receive()
            stack.pop_all()

    def _describe(self, name: str, options: Mapping[str, Any], mode: AutoresetMode) -> None:
        """Take over spaces and metadata from a single environment, which is closed again."""
        env = make_env(name, options)
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.metadata = {**env.metadata, "autoreset_mode": mode}
        self.render_mode, self.spec = env.render_mode, env.spec
        env.close()
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
            options: Passed to `reset` of each environment, except for ``reset_mask``, shape
                (num_envs,): which environments are reset if the autoreset mode is `DISABLED`.

        Raises:
            ConfigError: If the number or type of the seeds, or the mask, is wrong.
        """
        count = self.num_envs
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(count, np.bool_)))
        seeds = self._seeds(seed)
        if len(seeds) != count or mask.shape != (count,) or mask.dtype != np.bool_:
            raise ConfigError(
                f"reset() of {count} environments got {len(seeds)} seeds, and a mask of shape "
                f"{mask.shape} and type {mask.dtype}: give one seed and one bool for each."
            )
        if not mask.any():
            raise ConfigError("reset_mask does not select any environment.")
        shares = zip(self._split(seeds), self._split(mask.tolist()), strict=True)
        self._command(
            "reset", [{"seeds": s, "mask": m, "options": options or None} for s, m in shares]
        )
        records = self._receive()
        return self._observed(records), self._infos(records, {})

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        try:
            each = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
            return [None if one is None else operator.index(one) for one in each]
        except TypeError as error:
            raise ConfigError(f"The seeds are {seed!r} but must be whole numbers.") from error

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step all environments.

        Args:
            actions: A batch of actions: see `action_space`.

        Returns:
            Observations, rewards, terminations, truncations, each with a leading axis of
            environments, and infos.

        Raises:
            ActionError: If the actions do not have the shape of the space.
            PhysxError: If an environment raises, or a process fails.
        """
        self._open().apply(self._split_actions(actions), at_once=False)
        records = self._receive()
        terminated, truncated = records["terminated"].copy(), records["truncated"].copy()
        finals: dict[int, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP:
            names = [field.name for field in self._observations.fields]
            for i in np.flatnonzero(terminated | truncated).tolist():
                arrays = {name: records[f"final_{name}"][i].copy() for name in names}
                finals[i] = self._observations.value(arrays)
        infos = self._infos(records, finals)
        return self._observed(records), records["reward"].copy(), terminated, truncated, infos

    def _split_actions(self, actions: Any) -> Batch:
        """Return the actions by client: arrays of shape (clients, share, *shape)."""
        shares: Batch = {}
        try:
            given = self._actions.arrays(actions)
        except (TypeError, ValueError, LookupError) as error:
            raise ActionError(f"The actions do not fit {self.action_space}: {error}.") from error
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

    def _receive(self) -> Array:
        """Return the results of the last actions or command as records, shape (num_envs,)."""
        return self._row.records(self._open().batch(self._clients)[ROW])[: self.num_envs]

    def _observed(self, records: Array) -> Any:
        names = [field.name for field in self._observations.fields]
        return self._observations.batch(
            {name: records[name].copy() if self._copy else records[name] for name in names}
        )

    def _infos(self, records: Array, finals: Mapping[int, Any]) -> dict[str, Any]:
        kinds, data = records["info"], records["infos"]
        layout = self._reports.layout
        found = kinds.tobytes()
        if InfoKind.PACKED not in found and not finals:
            if InfoKind.NUMBERS not in found:
                return {}
            if layout is not None:
                return layout.columns(layout.records(data), kinds == InfoKind.NUMBERS)
        infos: dict[str, Any] = {}
        new: list[tuple[int, dict[str, Any]]] = []
        for i, kind in enumerate(kinds.tolist()):
            client, place = divmod(i, self._share)
            info: dict[str, Any] = {}
            if kind == InfoKind.NUMBERS:
                info = self._reports.info(client, data[i])
            elif kind == InfoKind.PACKED:
                report = unpack(data[i]) or self._reports.last(client)["infos"][str(place)]
                new.append((client, report))
                info = report["info"]
            if i in finals:
                info = {"final_obs": finals[i], **info}
            if info:
                infos = self._add_info(infos, info, i)
        for client, report in new:  # valid from the next row on
            self._reports.learn(client, report)
        return infos

    # Other methods -------------------------------------------------------------------------

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute; return the results.

        Raises:
            UsageError: If it is `reset`, `step` or `close`, or a result cannot be sent.
        """
        if name in FORBIDDEN:
            raise UsageError(f'call("{name}") would bypass this object: use {name}() itself.')
        self._command("call", [(name, list(args), kwargs)] * self._clients)
        self._receive()
        results = [self._reports.last(client)["results"] for client in range(self._clients)]
        return tuple(itertools.chain.from_iterable(results))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each environment: one value for all, or a list with one for each.

        Raises:
            ConfigError: If the number of values is not that of the environments.
        """
        each = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ConfigError(f"{len(each)} values for {self.num_envs} environments.")
        self._command("set", [(name, share) for share in self._split(each)])
        self._receive()

    def render(self) -> tuple[Any, ...]:
        """Return the frame that each environment renders."""
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
        """Send each client a command instead of actions."""
        self._open().apply({COMMAND: pack_commands(name, arguments)}, at_once=False)

    def _split(self, values: Sequence[Any]) -> list[list[Any]]:
        """Return the values of each client's environments."""
        return [
            list(values[first : first + self._share])
            for first in range(0, self.num_envs, self._share)
        ]


class _Reports:
    """Collects what clients report besides their rows, as the services of their run.

    Attributes:
        layout: Layout of the infos of all clients; None if they differ.
    """

    def __init__(self) -> None:
        self.layout: InfoLayout | None = None
        self._last: dict[int, dict[str, Any]] = {}
        self._layouts: dict[int, InfoLayout] = {}
        self._left_out: set[str] = set()

    def last(self, client: int) -> dict[str, Any]:
        """Return what a client, counted from 0, reported before its last row."""
        return self._last[client]

    def info(self, client: int, data: Array) -> dict[str, Any]:
        """Return an info from a record of the layout that a client announced last."""
        layout = self._layouts[client]
        return layout.info(layout.records(data[np.newaxis])[0])

    def learn(self, client: int, report: Mapping[str, Any]) -> None:
        """Remember the layout that an info was reported with; warn of entries left out."""
        if "layout" in report:
            self._layouts[client] = layout = InfoLayout(report["layout"])
            differ = any(other.names != layout.names for other in self._layouts.values())
            self.layout = None if differ else layout
        new = set(report.get("left_out", [])) - self._left_out
        if new:
            self._left_out |= new
            _LOG.warning(
                "Info entries are left out because they are neither plain values nor arrays: %s.",
                ", ".join(sorted(new)),
            )

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Store what a client reports before its row."""
        self._last[instance_id - 1] = values

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return nothing: workers do not ask for parameters."""
        return {}

    def predict(self, fields: Sample) -> Sample:
        """Raise an error: workers do not ask for predictions."""
        raise UsageError("A vector environment has no network.")

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Do nothing: workers do not draw."""
