"""Environments whose clients write their rows, a launcher that spoils their folder, and a run.

``python writer_envs.py WRITERS CLIENTS EPISODES`` goes on with the session "run" in this folder.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np

from physx_core import (
    DataGeneration,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    Parameter,
)
from physx_core.net import Kind, pack
from physx_core.net.values import encode
from physx_core.workers.launchers import SubprocessLauncher


class Walks(Environment):
    """Walks of random length at any pace; a client may kill itself, once."""

    independent_episodes = True

    def __init__(self, *, delay: float = 0.0, dies: tuple[int, int] = (-1, 0), **kwargs):
        super().__init__(**kwargs)
        self.delay, self.dies = delay, dies

    def create(self):
        self.define_parameters(Parameter("mass", 0.5, 1.5))

    def init_database(self):
        self.define_training_fields([Field("x", unit="m"), ("n", int)])
        self.define_additional_fields([Field("f", shape=(), dtype="float32")])
        self.define_episode_fields(Field("shape", shape=(3,)))

    def reset_parameters(self, mass):
        self.mass, self.left = mass, int(self.rng.integers(0, 12))
        self.set_episode_data(shape=np.full(3, mass))

    def step(self):
        if not self.left:
            self.end_episode()
            return
        self.left -= 1
        time.sleep(self.delay * int.from_bytes(os.urandom(2), "little") / 65536)
        if (self.episode_index, self.step_index) == tuple(self.dies) and not Path("died").exists():
            Path("died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        x = self.mass * self.rng.normal(size=30)
        self.set_training_data(x=x, n=self.step_index)
        self.set_additional_data(f=np.float32(x.sum()))

    def check_sample(self):
        return self.rng.random() < 0.8


class Stream(Environment):
    """A stream."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(("n", int))

    def step(self):
        self.set_training_data(n=self.step_index)


class Large(Environment):
    """Fills a small disk."""

    episode_steps = 10

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(Field("x", shape=(5000,)))

    def reset_parameters(self):
        pass

    def step(self):
        time.sleep(2e-3)  # else a block of rows fills the disk
        self.set_training_data(x=np.full(5000, self.episode_index + self.step_index / 100))


class Rogue(Walks):
    """Sends a message of its own, which a client would not send."""

    def __init__(self, *, kind: str, number: int, value=None, **kwargs):
        super().__init__(**kwargs)
        if value == "plausible":
            names = ("x", "n", "f", "env_id", "episode", "step")
            value = dict.fromkeys(names, 0)
        self.message = pack(Kind[kind], encode(value), number)

    def step(self):
        super().step()
        if self.episode_index >= 20 and not Path("sent").exists():
            Path("sent").touch()
            connection().sendall(self.message)


def connection():
    """The client's connection to its server, found among the open files of the process."""
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found = socket.socket(fileno=os.dup(int(entry.name)))
            found.getpeername()
        except OSError:
            continue
        return found
    raise LookupError("no connection")


class Elsewhere(SubprocessLauncher):
    """Starts clients that find another folder under the same path, as on another machine."""

    def __init__(self, *, content: str | None = None) -> None:
        super().__init__()
        self.content = content

    def launch(self, instances, address, token):
        """Change what the run wrote before the clients can look."""
        for path in Path("sessions").glob("*/dataset/dataset.clients"):
            path.unlink()
            if self.content is not None:
                path.write_text(self.content)
        return super().launch(instances, address, token)


def main(writers, clients, episodes):
    """Simulate what is missing in the session."""
    environment = EnvironmentConfig(
        Walks, num_clients=int(clients), env_kwargs={"delay": 0.003}, seed=3,
        record_wrong_samples=True, retries=1000,
    )  # fmt: skip
    with DataGeneration(
        environment,
        DatasetConfig(writers=writers, max_file_size=3e-5),
        episodes=int(episodes),
        session_name="run",
        resume=Path("sessions/run/dataset/dataset.json").exists(),
        quiet=True,
    ) as run:
        run.execute()


if __name__ == "__main__":
    main(*sys.argv[1:])
