"""A vector environment over bare shared memory: gym.py's baseline for `gymnasium.make_vec`.

It only does what a step needs: no checks, no infos, no handling of faults, Box spaces alone, and
busy waiting.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

END = -1


class Memory:
    """Arrays in shared memory.

    Attributes:
        actions: Shape (environments, width of an action).
        results: Observation, reward, terminated and truncated of each environment.
        counters: For this process and each other one, the number of steps begun or done.
    """

    def __init__(self, block: SharedMemory, count: int, width: int, others: int) -> None:
        numbers = np.frombuffer(block.buf)
        self.actions = numbers[: count * width].reshape(count, width)
        self.counters = numbers[count * width :][: 8 * (others + 1)].view(np.int64)[::8]
        rest = numbers[count * width + 8 * (others + 1) :]
        self.results = rest[: len(rest) // count * count].reshape(count, -1)


class RawVectorEnv:
    """Environments that are stepped in other processes."""

    def __init__(self, name: str, num_envs: int, processes: int) -> None:
        """Start the processes."""
        with gymnasium.make(name) as env:
            self.action_space = batch_space(env.action_space, num_envs)
            width, seen = env.action_space.shape[0], env.observation_space.shape[0]
        size = num_envs * (width + seen + 3) + 8 * (processes + 1)
        self._block = SharedMemory(create=True, size=8 * size)
        self._sizes = num_envs, width, processes
        self._memory = Memory(self._block, *self._sizes)
        self._memory.counters[:] = 0
        context = multiprocessing.get_context("spawn")
        self._processes = [
            context.Process(target=serve, args=(name, self._block, self._sizes, number))
            for number in range(processes)
        ]
        for process in self._processes:
            process.start()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Step all environments; return observations, rewards, terminations, truncations."""
        memory = self._memory
        memory.actions[:] = actions
        memory.counters[0] += 1
        while memory.counters[1:].min() < memory.counters[0]:
            os.sched_yield()
        observations, rewards, over, cut = np.split(memory.results, [-3, -2, -1], axis=1)
        return observations.copy(), rewards[:, 0].copy(), over[:, 0] != 0, cut[:, 0] != 0

    def close(self) -> None:
        """End the processes."""
        self._memory.counters[0] = END
        for process in self._processes:
            process.join()
        del self._memory
        self._block.close()
        self._block.unlink()


def serve(name: str, block: SharedMemory, sizes: tuple[int, int, int], number: int) -> None:
    """Step some environments until the end; an episode that is over is reset."""
    import physx_gym  # noqa: F401 - registers the environments

    memory = Memory(block, *sizes)
    count, _, processes = sizes
    mine = range(count * number // processes, count * (number + 1) // processes)
    envs: list[Any] = [gymnasium.make(name, disable_env_checker=True) for _ in mine]
    kind = envs[0].action_space.dtype
    over, done, counters = [True] * count, 0, memory.counters
    while True:
        looks = 0
        while counters[0] == done:
            looks += 1
            if looks < 10_000:
                os.sched_yield()
            else:  # it is another one's turn
                time.sleep(5e-3)
        if counters[0] == END:
            return
        for place, env in zip(mine, envs, strict=True):
            row = memory.results[place]
            if over[place]:
                row[:-3], _ = env.reset()
                row[-3:], over[place] = 0.0, False
            else:
                row[:-3], *ends, _ = env.step(memory.actions[place].astype(kind))
                row[-3:], over[place] = ends, any(ends[1:])
        done += 1
        counters[number + 1] = done
