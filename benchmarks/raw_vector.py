"""A vector environment over bare sockets: what gym.py compares `gymnasium.make_vec` with.

It does what a step needs and nothing else: no checks, no infos, no faults, Box spaces alone.
"""

from __future__ import annotations

import socket
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np


class RawVectorEnv:
    """Environments that are stepped in processes, over a socket each."""

    def __init__(self, name: str, num_envs: int, processes: int) -> None:
        """Start the processes."""
        self._processes, self._connections = [], []
        with gymnasium.make(name) as env, socket.create_server(("127.0.0.1", 0)) as listener:
            self._width = env.observation_space.shape[0]
            port, share = listener.getsockname()[1], num_envs // processes
            command = [sys.executable, __file__, name, str(share), str(port)]
            for _ in range(processes):
                self._processes.append(subprocess.Popen(command))
                connection, _ = listener.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._connections.append(connection)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Step all environments; return observations, rewards, terminations, truncations."""
        parts = np.split(actions, len(self._connections))
        for connection, part in zip(self._connections, parts, strict=True):
            connection.sendall(part)
        size = 8 * len(parts[0]) * (self._width + 3)
        answers = [c.recv(size, socket.MSG_WAITALL) for c in self._connections]
        table = np.frombuffer(b"".join(answers)).reshape(len(actions), -1)
        observations, rewards, over, cut = np.split(table, [self._width, -2, -1], axis=1)
        return observations.copy(), rewards[:, 0].copy(), over[:, 0] != 0, cut[:, 0] != 0

    def close(self) -> None:
        """End the processes."""
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.wait()


def serve(name: str, count: int, port: int) -> None:
    """Step some environments as long as actions come; an episode that is over begins again."""
    import physx_gym  # noqa: F401 - registers the environments

    envs: list[Any] = [gymnasium.make(name, disable_env_checker=True) for _ in range(count)]
    answers = np.zeros((count, envs[0].observation_space.shape[0] + 3))
    space = envs[0].action_space
    size = count * space.dtype.itemsize * space.shape[0]
    over = [True] * count
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while len(data := connection.recv(size, socket.MSG_WAITALL)) == size:
            actions = np.frombuffer(data, space.dtype).reshape(count, -1)
            for place, env in enumerate(envs):
                if over[place]:
                    answers[place, :-3], _ = env.reset()
                    answers[place, -3:] = 0.0
                    over[place] = False
                else:
                    answers[place, :-3], *ends, _ = env.step(actions[place])
                    answers[place, -3:] = ends
                    over[place] = any(ends[1:])
            connection.sendall(answers)


if __name__ == "__main__":
    serve(sys.argv[1], *map(int, sys.argv[2:]))
