"""PhysxVectorEnv: all worlds of a service as a vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from physx_core import Closeable
from physx_core.errors import ActionError, ConfigError, EpisodeError
from physx_core.typing import Array
from physx_remote.errors import RemoteProtocolError
from physx_remote.physx.client import PhysxClient
from physx_remote.physx.wire import REWARD, TERMINATED, TRUNCATED
from physx_remote.serving.spaces import MALFORMED_INPUT_ERRORS


class PhysxVectorEnv(VectorEnv[Any, Any, Any], Closeable):
    """All worlds of a service, stepped with one request. Closing it closes the connection.

    Attributes:
        client: The connection.
    """

    def __init__(
        self, client: PhysxClient, *, autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP
    ) -> None:
        """Use all worlds of a service.

        Args:
            client: The connection.
            autoreset_mode: What happens after the end of an episode: ``"NextStep"``, ``"SameStep"``
                or ``"Disabled"``, as in Gymnasium.

        Raises:
            ConfigError: If the mode is unknown.
        """
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(f'"{mode.value}"' for mode in AutoresetMode)
            raise ConfigError(f"autoreset_mode is {autoreset_mode!r}; known: {known}.") from None
        self.client = client
        self.num_envs = count = client.num_worlds
        self.single_observation_space = client.observations.space
        self.single_action_space = client.actions.space
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self.metadata = {**client.metadata, "autoreset_mode": self._mode}
        self.render_mode = client.render_mode
        self.spec = None
        self._over = np.zeros(count, np.bool_)
        self._last: dict[str, Array] = {}

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; return observations and infos.

        Args:
            seed: World i gets ``seed + i``; or a list with a seed for each.
            options: Passed to each world's `reset`, except for ``reset_mask``, shape (num_envs,):
                the worlds to reset.

        Raises:
            ConfigError: If the number of seeds or the mask does not match the worlds.
            PhysxError: If a world raises, or the service disconnects or does not answer in time.
        """
        count = self.num_envs
        seeds = [seed + i for i in range(count)] if isinstance(seed, int) else seed
        seeds = [None] * count if seeds is None else list(seeds)
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(count, np.bool_)))
        if len(seeds) != count or mask.shape != (count,) or mask.dtype != np.bool_:
            raise ConfigError(
                f"reset() of {count} worlds got {len(seeds)} seeds, and a mask of shape "
                f"{mask.shape} and type {mask.dtype}: pass one seed and one bool per world."
            )
        if not mask.any():
            raise ConfigError("reset_mask selects no world.")
        worlds = np.flatnonzero(mask).tolist()
        chosen = None if len(worlds) == count else worlds
        begun = self.client.reset(
            chosen, seeds=[seeds[world] for world in worlds], options=options or None
        )
        if chosen is None:
            self._last = begun.arrays
        elif not self._last:
            raise ConfigError("The first reset() must reset all worlds: omit reset_mask.")
        else:
            self._last = {name: array.copy() for name, array in self._last.items()}
            self._take(worlds, begun.arrays)
        self._over[worlds] = False
        return self._observation(), self._infos(dict(zip(worlds, begun.infos, strict=True)))

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step all worlds.

        Args:
            actions: A batch of actions: see `action_space`.

        Returns:
            Observations, rewards, terminations, truncations, each with a leading axis of worlds,
            and infos. The caller owns the arrays.

        Raises:
            ActionError: If the actions do not have the shapes or types of the space.
            EpisodeError: If an episode is over and the mode is ``"Disabled"``.
            PhysxError: If a world raises, or the service disconnects or does not answer in time.
        """
        arrays = self._stack(actions)
        if self._over.any():
            infos = self._step_some(arrays)
        else:
            self.client.ask_step(arrays, None)
            self._last, found = self.client.outcomes(self.num_envs)
            infos = dict(enumerate(found))
        self._over = self._last[TERMINATED] | self._last[TRUNCATED]
        outcome = self._last[REWARD], self._last[TERMINATED], self._last[TRUNCATED]
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            self._reset_at_once(infos)
        return self._observation(), *outcome, self._infos(infos)

    def _stack(self, actions: Any) -> dict[str, Array]:
        arrays = self.client.actions.stack(actions)
        for array in arrays.values():
            if len(array) != self.num_envs:
                raise ActionError(
                    f"Got {len(array)} actions for {self.num_envs} worlds: pass one per world."
                )
        return arrays

    def _step_some(self, arrays: dict[str, Array]) -> dict[int, dict[str, Any]]:
        """Reset the worlds whose episodes are over, and step the others."""
        over = np.flatnonzero(self._over)
        if self._mode is AutoresetMode.DISABLED:
            raise EpisodeError(
                f"The episodes of worlds {over.tolist()} are over: reset them first, with "
                'options={"reset_mask": ...}.'
            )
        others = np.flatnonzero(~self._over)
        client = self.client
        client.ask_reset(over.tolist())
        if len(others):
            part = {name: array[others] for name, array in arrays.items()}
            client.ask_step(part, others.astype(np.int64))
        begun = client.outcomes(len(over), back=int(len(others) > 0))
        self._last = {name: array.copy() for name, array in self._last.items()}
        self._take(over, begun.arrays)
        infos = dict(zip(over.tolist(), begun.infos, strict=True))
        if len(others):
            stepped = client.outcomes(len(others))
            self._take(others, stepped.arrays)
            infos.update(zip(others.tolist(), stepped.infos, strict=True))
        return infos

    def _reset_at_once(self, infos: dict[int, dict[str, Any]]) -> None:
        """Start new episodes where they are over; the infos keep the final transition."""
        over = np.flatnonzero(self._over).tolist()
        observations = self.client.observations
        before = self._last
        begun = self.client.reset(over)
        finals = [observations.row(before, world) for world in over]
        self._last = {name: array.copy() for name, array in before.items()}
        self._take(over, begun.arrays)
        for world, final, info in zip(over, finals, begun.infos, strict=True):
            infos[world] = {"final_obs": final, "final_info": infos[world], **info}
        self._over = np.zeros(self.num_envs, np.bool_)

    def _take(self, worlds: Any, arrays: dict[str, Array]) -> None:
        for name, array in arrays.items():
            self._last[name][worlds] = array

    def _observation(self) -> Any:
        return self.client.observations.batch(self._last)

    def _infos(self, found: dict[int, dict[str, Any]]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for world in sorted(found):
            if found[world]:
                infos = self._joined(infos, found[world], world)
        return infos

    def _joined(self, infos: dict[str, Any], info: dict[str, Any], world: int) -> dict[str, Any]:
        try:
            return self._add_info(infos, info, world)
        except MALFORMED_INPUT_ERRORS as error:
            raise RemoteProtocolError(
                f"The infos of the worlds are incompatible, for example that of world {world}: "
                f"{error}."
            ) from error

    def render(self) -> tuple[Any, ...]:
        """Return the rendering of each world."""
        return tuple(self.client.render(world) for world in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the connection."""
        self.client.close()
