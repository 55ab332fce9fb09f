"""Vector environment whose environments run in several processes."""

from __future__ import annotations

import logging
import operator
import os
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import chain, pairwise
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from physx_core import Closeable
from physx_core.config import reference_of
from physx_core.errors import ActionError, ConfigError, UnknownOptionError, UsageError
from physx_core.net import Frame, Kind, count_cores, decode
from physx_core.processes import CLIENT_VARIABLE, anonymous_file
from physx_core.typing import Array, Batch
from physx_gym.bridge.make_env import make_env
from physx_gym.spaces import SpaceFields
from physx_gym.vector.batch import SharedBatch
from physx_gym.vector.client_workers import ClientWorkers
from physx_gym.vector.infos import InfoKind, InfoLayout, unpack
from physx_gym.vector.local_worker import LocalWorker
from physx_gym.vector.worker_group import WorkerGroup
from physx_gym.vector.workers import Workers

FORBIDDEN = ("reset", "step", "close")
"""Methods that `call` rejects."""

_HERE = "127.0.0.1"
_LOG = logging.getLogger("physx")


class ParallelVectorEnv(VectorEnv[Any, Any, Any], Closeable):
    """A vector environment whose environments are stepped in separate processes.

    ``gymnasium.make_vec("physx/Ant-v0", num_envs=8, num_processes=2)`` creates one. `step` behaves
    like that of Gymnasium's `AsyncVectorEnv`. `send` and `recv` do not wait for all environments:
    while the results of `batch_size` environments are processed, the others continue.

    With ``launcher="cluster/ray"``, the processes run wherever that launcher starts them.

    The processes write observations, rewards and ends to shared memory. They exit with the vector
    environment or with this process, however it ends. If an environment raises, the error has its
    traceback; if a process exits, the error says how and where. Either ends the vector environment.

    Infos may hold plain values and arrays; other entries are left out, and a warning names them.

    Attributes:
        batch_size: Number of environments whose results `recv` returns.
        autoreset_mode: What happens after the end of an episode.
    """

    def __init__(
        self,
        env: str | type[Any],
        num_envs: int = 1,
        *,
        env_kwargs: Mapping[str, Any] | None = None,
        num_processes: int | None = None,
        batch_size: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        timeout: float = 60.0,
        launcher: str | type[Any] | None = None,
        launcher_kwargs: Mapping[str, Any] | None = None,
        ip_address: str = _HERE,
        retries: int = 0,
    ) -> None:
        """Start the processes.

        Args:
            env: Id of the environment, ``"package.module:Class"``, ``"script.py:Class"``, or the
                class.
            num_envs: Number of environments.
            env_kwargs: Keyword arguments of each environment.
            num_processes: Number of processes that share the environments; None: one for each
                processor core, or, with a launcher, for each environment. There are never more than
                environments, and none for a single one, which is stepped in this process, unless it
                has a launcher.
            batch_size: Number of environments whose results `recv` returns; None: all.
            autoreset_mode: What happens after the end of an episode.
            copy: Whether the results of `reset` and `step` are copies; otherwise observations are
                views of the shared memory, valid until the next call.
            timeout: Longest duration of a step of an environment, in s. To create and to close its
                environments, a process has the same time, but at least a minute. The step of an
                environment in this process is not limited.
            launcher: Launcher that starts the processes, such as ``"cluster/ray"``; None: they are
                started here, and share memory with this process. Started by a launcher, they are
                clients, on any machine, and `recv` waits for all pending results.
            launcher_kwargs: Keyword arguments of the launcher.
            ip_address: Address at which clients reach this process, if the launcher knows none.
            retries: How often to restart a launcher's process that exits. The new one repeats all
                actions, so its environments must be deterministic; the actions are kept for this.

        Raises:
            ConfigError: If a value is out of range, or is only for a launcher, which is not given,
                or values of a space do not have a fixed shape.
            UnknownOptionError: If the autoreset mode is unknown.
            UsageError: If a worker runs a script without ``if __name__ == "__main__":``.
            PhysxError: If an environment or a process fails.
        """
        processes = count_cores() if launcher is None else num_envs
        workers = min(processes if num_processes is None else num_processes, num_envs)
        batch_size = num_envs if batch_size is None else batch_size
        _check(num_envs, workers, batch_size, env_kwargs, autoreset_mode)
        if launcher is None:
            _check_without_launcher(launcher_kwargs, ip_address, retries)
        name, options = reference_of(env), dict(env_kwargs or {})
        self.num_envs, self.batch_size = num_envs, batch_size
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._copy = copy
        self._describe(name, options)
        starts = [num_envs * number // workers for number in range(workers + 1)]
        self._starts, shares = starts, [stop - start for start, stop in pairwise(starts)]
        self._worker_of = np.repeat(np.arange(workers), shares).tolist()
        self._all = np.arange(num_envs)
        self._shares = [np.arange(share) for share in shares]
        # The environments with pending results, by worker, in the order in which it delivers them.
        self._pending: list[deque[int]] = [deque() for _ in range(workers)]
        self._is_pending = np.zeros(num_envs, np.bool_)
        self._next = 0  # the worker to take results from first
        self._infos = _Infos(workers)
        fields = self._observations.fields, self._actions.fields
        setup = {
            "env": name,
            "options": options,
            "autoreset": self.autoreset_mode.value,
            "shares": shares,
            "observations": [field.to_dict() for field in fields[0]],
            "actions": [field.to_dict() for field in fields[1]],
        }
        has_finals = self.autoreset_mode is AutoresetMode.SAME_STEP
        with anonymous_file("physx_vector") as file:
            self._batch = SharedBatch(file.fileno(), shares, *fields, has_finals=has_finals)
            self._workers: WorkerGroup
            if launcher is None and num_envs == 1:
                self._workers = LocalWorker(self._batch, setup)
            elif launcher is None:
                self._workers = Workers(self._batch, file.fileno(), setup, timeout)
            else:
                config = {
                    "launcher": launcher,
                    "launcher_kwargs": dict(launcher_kwargs or {}),
                    "ip_address": ip_address,
                    "retries": retries,
                    "timeout": timeout,
                }
                self._workers = ClientWorkers(self._batch, setup, config)
        weakref.finalize(self, self._workers.close, orderly=False).atexit = False

    def _describe(self, name: str, options: Mapping[str, Any]) -> None:
        """Copy spaces and metadata from a single environment, which is then closed."""
        env = make_env(name, options)
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.metadata = {**env.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode, self.spec = env.render_mode, env.spec
        env.close()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._observations = SpaceFields(self.single_observation_space, "observation")
        self._actions = SpaceFields(self.single_action_space, "action")

    # Steps ----------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; return observations and infos.

        Pending results are dropped.

        Args:
            seed: Environment i gets ``seed + i``; or a seed for each.
            options: Passed to `reset` of each environment, except for ``reset_mask``, shape
                (num_envs,): which environments are reset if the autoreset mode is `DISABLED`.

        Raises:
            ConfigError: If the number or type of the seeds, or the mask, is wrong.
        """
        self.async_reset(seed=seed, options=options)
        begun = self._take(self.num_envs)
        kinds = np.zeros_like(self._batch.kinds)
        kinds[begun] = self._batch.kinds[begun]
        return self._observed(None), self._infos_of(None, kinds)

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step all environments.

        Args:
            actions: A batch of actions: see `action_space`.

        Returns:
            Observations, rewards, terminations, truncations, each with a leading axis of
            environments, and infos.

        Raises:
            ActionError: If the actions do not have the shape of the space.
            UsageError: If results of `send` are pending.
            PhysxError: If an environment raises, or a process fails.
        """
        if any(self._pending):
            self.send(actions)  # which names one of them
        workers = self._open()
        for name, array in self._action_arrays(actions, self.num_envs).items():
            self._batch.actions[name][:] = array
        try:
            for number, mine in enumerate(self._shares):
                workers.ask(number, mine)
            workers.wait(sum(workers.asked))
        except BaseException:  # after an interrupt, `recv` and `reset` wait for them
            self._set_all_pending()
            raise
        self._read_messages()
        return self._results(None)

    def async_reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Start new episodes as `reset` does, without waiting; `recv` returns the observations.

        Raises:
            ConfigError: If the number or type of the seeds, or the mask, is wrong.
            PhysxError: If an environment raises, or a process fails.
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
        workers = self._open()
        self._take(count)
        arguments = []
        for start, stop in pairwise(self._starts):
            places = np.flatnonzero(mask[start:stop]).tolist()
            chosen = [seeds[start + place] for place in places]
            arguments.append({"places": places, "seeds": chosen, "options": options or None})
        workers.command("reset", arguments)
        self._ask(np.flatnonzero(mask))

    def send(self, actions: Any, env_ids: Any = None) -> None:
        """Have environments start a step; `recv` returns the results.

        Args:
            actions: A batch of actions, one for each of these environments.
            env_ids: Numbers of the environments, shape (n,); None: all.

        Raises:
            ActionError: If the actions do not have the shape of the space.
            ConfigError: If the numbers are not those of different environments.
            UsageError: If the result of one environment's last step is still pending.
            PhysxError: If a process has ended.
        """
        self._open()
        ids = self._all if env_ids is None else self._chosen(env_ids)
        if self._is_pending.any() and len(pending := ids[self._is_pending[ids]]):
            raise UsageError(
                f"The result of environment {pending[0]} is still pending: call recv() before "
                "sending it another action, or start over with reset()."
            )
        for name, array in self._action_arrays(actions, len(ids)).items():
            self._batch.actions[name][slice(None) if ids is self._all else ids] = array
        self._ask(ids if ids is self._all else np.sort(ids))

    def recv(self) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Wait for the results of `batch_size` environments, or for all pending ones, if fewer.

        They are taken in the order in which the processes deliver them, from each process in turn,
        so that none is neglected.

        Returns:
            What `step` returns, for these environments in the order of their numbers, which are in
            ``infos["env_id"]``. After a reset, rewards are 0.

        Raises:
            UsageError: If no result is pending.
            PhysxError: If an environment raises, or a process fails.
        """
        self._open()
        ids = self._take(self.batch_size)
        if not len(ids):
            raise UsageError("No result is pending: call send() or async_reset() first.")
        observations, *results, infos = self._results(ids)
        return observations, *results, {**infos, "env_id": ids.copy()}

    @property
    def num_pending(self) -> int:
        """Number of environments whose result is pending."""
        return int(self._is_pending.sum())

    def _ask(self, ids: Array) -> None:
        """Have environments step."""
        workers = self._open()
        if ids is self._all:
            self._set_all_pending()
            for number, mine in enumerate(self._shares):
                workers.ask(number, mine)
            return
        self._is_pending[ids] = True
        ends = ids.searchsorted(self._starts).tolist()  # where each worker's environments end
        for number, (first, last) in enumerate(pairwise(ends)):
            if first < last:
                mine = ids[first:last]
                self._pending[number].extend(mine.tolist())
                workers.ask(number, mine - self._starts[number])

    def _set_all_pending(self) -> None:
        """Note that the results of all environments are pending."""
        self._is_pending[:] = True
        for owed, bounds in zip(self._pending, pairwise(self._starts), strict=True):
            owed.extend(range(*bounds))

    def _read_messages(self) -> None:
        messages = self._workers.messages
        if messages:
            self._infos.learn(messages)
            messages.clear()

    def _take(self, count: int) -> Array:
        """Wait for `count` results, or all pending ones; return their environments, in order."""
        workers, owed = self._open(), [len(each) for each in self._pending]
        total = sum(owed)
        count = min(count, total)
        done = workers.wait(sum(workers.asked) - total + count)
        if count == total:  # no need to know which come first
            taken = self._all if count == self.num_envs else np.flatnonzero(self._is_pending)
            for each in self._pending:
                each.clear()
        else:
            ready = [n - (a - d) for n, a, d in zip(owed, workers.asked, done, strict=True)]
            found: list[int] = []
            while len(found) < count:
                if ready[self._next]:
                    ready[self._next] -= 1
                    found.append(self._pending[self._next].popleft())
                self._next = (self._next + 1) % len(ready)
            taken = np.array(sorted(found))
        self._is_pending[taken] = False
        self._read_messages()
        return taken

    def _chosen(self, env_ids: Any) -> Array:
        ids = np.asarray(env_ids)
        if (
            ids.ndim != 1
            or ids.dtype.kind not in "iu"
            or len(set(ids.tolist())) < len(ids)
            or not ((ids >= 0) & (ids < self.num_envs)).all()
        ):
            raise ConfigError(
                f"env_ids is {env_ids!r} but must be an array of numbers of different "
                f"environments, from 0 to {self.num_envs - 1}."
            )
        return ids

    def _action_arrays(self, actions: Any, count: int) -> Batch:
        """Return a batch of actions as arrays of shape (count, *shape)."""
        try:
            arrays = self._actions.arrays(actions)
        except (TypeError, ValueError, LookupError) as error:
            raise ActionError(f"The actions do not fit {self.action_space}: {error}.") from error
        for field in self._actions.fields:
            shape, wanted = arrays[field.name].shape, (count, *(field.shape or ()))
            if shape != wanted:
                raise ActionError(
                    f"The actions have the shape {shape} but need {wanted}: one action of "
                    f"{self.single_action_space} for each environment."
                )
        return arrays

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        try:
            each = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
            return [None if one is None else operator.index(one) for one in each]
        except TypeError as error:
            raise ConfigError(f"The seeds are {seed!r} but must be whole numbers.") from error

    # Results --------------------------------------------------------------------------------

    def _results(self, ids: Array | None) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Return the results of environments; None: of all."""
        batch = self._batch
        results = batch.rewards, batch.terminated, batch.truncated, batch.kinds
        if ids is None:
            rewards, terminated, truncated, kinds = [array.copy() for array in results]
        else:
            rewards, terminated, truncated, kinds = [array[ids] for array in results]
        over = terminated | truncated if batch.finals else None
        infos = self._infos_of(ids, kinds, over)
        return self._observed(ids), rewards, terminated, truncated, infos

    def _observed(self, ids: Array | None) -> Any:
        seen = self._batch.observations
        if ids is not None:
            return self._observations.batch({name: array[ids] for name, array in seen.items()})
        copied = {name: array.copy() if self._copy else array for name, array in seen.items()}
        return self._observations.batch(copied)

    def _infos_of(
        self, ids: Array | None, kinds: Array, over: Array | None = None
    ) -> dict[str, Any]:
        """Return infos in the form of Gymnasium's vector environments.

        Args:
            ids: The environments; None: all.
            kinds: The forms of their infos.
            over: Whether their episodes are over, if their last observations are kept; None: they
                have just begun, or are not kept.
        """
        batch, found = self._batch, set(kinds.tolist())
        found.discard(InfoKind.NONE)
        has_finals = over is not None and bool(over.any())
        if not found and not has_finals:
            return {}
        if len(found) == 1 and not has_finals:
            (kind,) = found
            layout = self._infos.common(kind)
            if layout is not None:
                data = batch.infos if ids is None else batch.infos[ids, : layout.dtype.itemsize]
                return layout.columns(layout.records(data), kinds == kind)
        numbers = self._all if ids is None else ids
        vector: VectorEnv[Any, Any, Any] = VectorEnv()
        vector.num_envs = len(numbers)
        infos: dict[str, Any] = {}
        for place, (i, kind) in enumerate(zip(numbers.tolist(), kinds.tolist(), strict=True)):
            info = self._infos.info(i, self._worker_of[i], kind, batch.infos[i])
            if has_finals and over is not None and over[place]:
                arrays = {name: array[i].copy() for name, array in batch.finals.items()}
                info = {"final_obs": self._observations.value(arrays), **info}
            infos = vector._add_info(infos, info, place)
        return infos

    # Other methods --------------------------------------------------------------------------

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute; return the results.

        Raises:
            UsageError: If it is `reset`, `step` or `close`, or a result cannot be sent.
        """
        if name in FORBIDDEN:
            raise UsageError(f'call("{name}") would bypass this object: call {name}() directly.')
        arguments = [(name, list(args), kwargs)] * len(self._pending)
        return tuple(chain.from_iterable(self._open().command("call", arguments)))

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
        shares = [(name, each[start:stop]) for start, stop in pairwise(self._starts)]
        self._open().command("set", shares)

    def render(self) -> tuple[Any, ...]:
        """Return the frame that each environment renders."""
        return self.call("render")

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        workers = getattr(self, "_workers", None)
        if workers is not None:
            workers.close(orderly=True)

    def _open(self) -> WorkerGroup:
        if not self._workers.is_open:
            raise UsageError("This vector environment is closed, or ended with an error.")
        return self._workers


def _check_without_launcher(
    launcher_kwargs: Mapping[str, Any] | None, ip_address: str, retries: int
) -> None:
    given = {
        "launcher_kwargs": bool(launcher_kwargs),
        "ip_address": ip_address != _HERE,
        "retries": retries != 0,
    }
    if unused := [name for name, is_given in given.items() if is_given]:
        raise ConfigError(
            f"{' and '.join(unused)} would have no effect without a launcher, whose processes are "
            'clients. Add launcher="physx/subprocess" to start them on this machine.'
        )


def _check(
    num_envs: int,
    workers: int,
    batch_size: int,
    env_kwargs: Mapping[str, Any] | None,
    autoreset_mode: AutoresetMode | str,
) -> None:
    """Check the arguments of a vector environment."""
    if os.environ.get(CLIENT_VARIABLE):
        raise UsageError(
            "A worker imported the script that defines its environment, and the script created a "
            'vector environment. Put that under  if __name__ == "__main__":'
        )
    if workers < 1 or not 1 <= batch_size <= num_envs:
        raise ConfigError(
            f"num_envs is {num_envs} and num_processes {workers}, but both must be at least 1; "
            f"batch_size is {batch_size}, but must be between 1 and num_envs."
        )
    if not isinstance(env_kwargs or {}, Mapping):
        raise ConfigError(f"env_kwargs is {env_kwargs!r} but must be a dictionary.")
    modes = {each.value: each for each in AutoresetMode}
    if not isinstance(autoreset_mode, AutoresetMode) and autoreset_mode not in modes:
        raise UnknownOptionError("autoreset_mode", [str(autoreset_mode)], modes)


class _Infos:
    """What is needed to read infos: the workers' layouts, and infos that did not fit."""

    def __init__(self, workers: int) -> None:
        self._layouts: list[dict[int, InfoLayout]] = [{} for _ in range(workers)]
        self._common: dict[int, InfoLayout | None] = {}
        self._sent: dict[int, dict[str, Any]] = {}
        self._left_out: set[str] = set()

    def learn(self, messages: Sequence[tuple[int, Frame]]) -> None:
        """Store what workers sent; warn about entries that they left out."""
        for worker, frame in messages:
            value = decode(frame.payload)
            if frame.kind is Kind.FIELDS:
                number, layout = frame.number, InfoLayout(value)
                self._layouts[worker][number] = layout
                known = [each[number] for each in self._layouts if number in each]
                differ = any(other.names != layout.names for other in known)
                self._common[number] = None if differ else layout
            else:
                self._sent[frame.number] = value["info"]
                self._warn(value["left_out"])

    def common(self, kind: int) -> InfoLayout | None:
        """Return the layout of a number, if it is the same for all workers that sent one."""
        return self._common.get(kind)

    def info(self, env: int, worker: int, kind: int, data: Array) -> dict[str, Any]:
        """Return the info of an environment."""
        if kind == InfoKind.NONE:
            return {}
        if kind == InfoKind.SENT:
            return self._sent.pop(env)
        found: dict[str, Any]
        found = unpack(data) if kind == InfoKind.PACKED else self._layouts[worker][kind].info(data)
        return found

    def _warn(self, left_out: Sequence[str]) -> None:
        new = set(left_out) - self._left_out
        if new:
            self._left_out |= new
            _LOG.warning(
                "Info entries are left out because they are neither plain values nor arrays: %s.",
                ", ".join(sorted(new)),
            )
