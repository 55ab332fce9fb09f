"""An environment whose clients write their rows, a launcher that spoils their folder, and a run.

``python writer_envs.py WRITERS CLIENTS BATCHES SIZE`` adds to the session "run" in this folder.
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


class Steps(Environment):
    """Numbers that follow from the seed, at any pace; an instance may kill itself, once."""

    def __init__(self, *, delay: float = 0.0, dies: tuple[int, int] = (0, 0), **kwargs):
        super().__init__(**kwargs)
        self.delay, self.dies = delay, dies

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("x", unit="m"), ("n", int)])
        self.define_additional_fields([Field("f", shape=(), dtype="float32")])

    def step(self):
        time.sleep(self.delay * int.from_bytes(os.urandom(2), "little") / 65536)
        if (self.instance_id, self.step_index) == tuple(self.dies) and not Path("died").exists():
            Path("died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if self.rng.random() < 0.1:
            self.new_episode()
        x = self.rng.normal(size=30)
        self.set_training_data(x=x, n=self.step_index)
        self.set_additional_data(f=np.float32(x.sum()))

    def check_sample(self):
        return self.rng.random() < 0.8


class Large(Steps):
    """Fills a small disk."""

    def init_database(self):
        self.define_training_fields(Field("x", shape=(5000,)))

    def step(self):
        self.set_training_data(x=np.full(5000, self.step_index + self.instance_id / 10))

    def check_sample(self):
        return True


class Rogue(Steps):
    """Sends a message of its own, which a client would not send."""

    def __init__(self, *, kind: str, number: int, value=None, **kwargs):
        super().__init__(**kwargs)
        if value == "plausible":
            names = ("mean", "squares", "minimum", "maximum")
            value = {
                "rows": 3,
                "checksums": dict.fromkeys(("x", "n", "f", "env_id", "episode", "step"), 0),
                "statistics": {
                    name: {"count": np.array(3), **{each: np.zeros(shape) for each in names}}
                    for name, shape in (("x", 30), ("f", ()))
                },
            }
        self.message = pack(Kind[kind], encode(value), number)

    def step(self):
        super().step()
        if self.instance_id == 2 and self.step_index == 5:
            wait_for_partitions()
            connection().sendall(self.message)


def wait_for_partitions():
    """Wait until the server has begun partitions: it needs a row of instance 1 for that."""
    until = time.monotonic() + 30
    while not list(Path("sessions").glob("*/dataset/*_training_*.h5")):
        if time.monotonic() > until:
            raise TimeoutError("the server has begun no partition")
        time.sleep(0.01)


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


class Gaps(Steps):
    """Comes upon NaN."""

    def step(self):
        super().step()
        if self.instance_id == 2 and self.step_index >= 30:
            self.set_training_data(x=np.full(30, np.nan), n=0)


class Drawn(Steps):
    """Has a parameter."""

    def create(self):
        self.define_parameters([Parameter("mass", 0.5, 1.5)])


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


def main(writers, clients, batches, size):
    """Add rows to the session."""
    environment = EnvironmentConfig(
        Steps, num_clients=int(clients), env_kwargs={"delay": 0.003}, seed=3
    )
    dataset = DatasetConfig(writers=writers, max_file_size=3e-5)
    options = {"session_name": "run", "new_session": False, "quiet": True}
    with DataGeneration(
        environment, dataset, batch_nb=int(batches), batch_size=int(size), **options
    ) as run:
        run.execute()


if __name__ == "__main__":
    main(*sys.argv[1:])
