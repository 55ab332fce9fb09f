"""Environments that client processes import by the path of this file."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Field
from physx_core.errors import FieldShapeError


def sleep(seconds):
    """Sleep, by the clock of the simulation if this client is in one."""
    simulation = sys.modules["simulated"].Simulation.current if "simulated" in sys.modules else None
    (simulation or time).sleep(seconds)


class Walk(Environment):
    """A random walk: five numbers in, one out, in an open and a known shape; fields of any type."""

    def __init__(self, *, size: int = 5, delay: float = 0.0, refuse: int = 0, **kwargs):
        super().__init__(**kwargs)
        self.size, self.delay, self.refuse = size, delay, refuse
        self.state = np.zeros(size)

    def create(self):
        self.count = 0

    def init_database(self):
        self.define_training_fields([("state", np.ndarray), Field("mean", shape=())])
        self.define_additional_fields([Field("flags", shape=(2,), dtype="bool"), ("count", int)])

    def step(self):
        if self.delay:
            sleep(self.delay * self.rng.random())
        self.count += 1
        self.state = self.state + self.rng.normal(size=self.size)
        self.set_training_data(state=self.state, mean=self.state.mean())
        self.set_additional_data(flags=self.state[:2] > 0, count=self.count)

    def check_sample(self):
        return not self.refuse or self.count % self.refuse != 0


class Plain(Environment):
    """One number for each step: instance and step."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(Field("x", shape=(2,)))

    def step(self):
        self.act()
        self.set_training_data(x=np.array([self.instance_id, self.step_index], float))

    def act(self):
        pass


class Unhurried(Plain):
    """Leaves the processor to others most of the time."""

    def act(self):
        sleep(0.002)


class Trouble(Plain):
    """Does something bad in one method of one instance, at one step."""

    def __init__(self, *, what: str, method: str = "step", at: int = 3, who: int = 1, **kwargs):
        self.what, self.method, self.at, self.who = what, method, at, who
        super().__init__(**kwargs)
        self.do("__init__")

    def do(self, method):
        if method == self.method and self.instance_id == self.who:
            getattr(self, self.what)()

    def create(self):
        self.do("create")

    def init_database(self):
        super().init_database()
        self.do("init_database")

    def act(self):
        if self.step_index == self.at:
            self.do("step")

    def apply_prediction(self, prediction):
        self.do("apply_prediction")

    def close(self):
        self.do("close")

    def fail(self):
        raise RuntimeError("no more beans")

    def fail_known(self):
        error = FieldShapeError("mine", field="x", instance_id=7, step=9)
        error.add_note("a note")
        raise error

    def leave(self):
        sys.exit(5)

    def vanish(self):
        print("last words", file=sys.stderr, flush=True)
        os._exit(3)

    def spin(self):
        while True:
            pass

    def sleep(self):
        sleep(60)

    def hang(self):
        sleep(1e9)

    def crash(self):
        ctypes.string_at(0)

    def leave_child(self):
        child = subprocess.Popen(["sleep", "60"])
        Path(os.environ["PHYSX_TEST_CHILD"]).write_text(str(child.pid))


class AskingTrouble(Trouble):
    """Asks the network, but for the instance that makes trouble."""

    def act(self):
        super().act()
        if self.instance_id != self.who:
            self.get_prediction(x=np.array([self.instance_id]))


class Bad(Plain):
    """Gives what cannot be stored at one step."""

    def __init__(self, *, value, field: str = "x", at: int = 3, who: int = 1, **kwargs):
        super().__init__(**kwargs)
        self.value, self.field, self.at, self.who = value, field, at, who

    def step(self):
        super().step()
        if self.step_index == self.at and self.instance_id == self.who:
            self.set_training_data(**{self.field: self.value})


class Shapes(Environment):
    """Open shapes that differ between the instances."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([("x", np.ndarray)])

    def step(self):
        self.set_training_data(x=np.zeros(self.instance_id))


class Asking(Plain):
    """Asks the network in each step."""

    def __init__(self, *, delay: float = 0.0, **kwargs):
        super().__init__(**kwargs)
        self.delay = delay

    def create(self):
        self.kept = self.load_parameters()
        self.save_parameters(instance=self.instance_id, table=np.arange(3), kept=self.kept)

    def step(self):
        x = np.array([self.instance_id, self.step_index], float)
        sleep(self.delay * self.instance_id * self.rng.random())
        predicted = self.get_prediction(x=x, number=self.step_index)
        self.set_training_data(x=predicted["y"])


class Stubborn(Plain):
    """Goes on when a prediction fails; its second row is not finite."""

    def step(self):
        self.set_training_data(x=np.full(2, np.nan if self.step_index == 1 else self.step_index))
        if self.step_index >= 2:
            try:
                self.get_prediction(x=1)
            except Exception:
                self.failed = True


class Applied(Plain):
    """Its rows hold what was applied."""

    value = 0.0

    def step(self):
        self.set_training_data(x=np.array([self.value, self.step_index], float))

    def apply_prediction(self, prediction):
        self.value = 10 * self.value + prediction["y"].item()


class Drawing(Plain):
    """Draws points in each step."""

    def __init__(self, *, pace: float = 0.0, **kwargs):
        super().__init__(**kwargs)
        self.pace = pace

    def init_visualization(self):
        self.factory.add_points("cloud", np.arange(6.0).reshape(2, 3), color="red")

    def act(self):
        sleep(self.pace)
        self.factory.update_points("cloud", positions=np.full((2, 3), self.step_index / 3))
        self.update_visualization()


class Echo(Environment):
    """Tells in its sample whether its options arrived exactly."""

    def __init__(self, *, options, **kwargs):
        super().__init__(**kwargs)
        self.options = options

    def create(self):
        self.save_parameters(options=self.options)

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=0.0)


class Surroundings(Environment):
    """Keeps what its process looks like."""

    def create(self):
        self.save_parameters(
            client=os.environ.get("PHYSX_CLIENT"),
            token=os.environ.get("PHYSX_TOKEN"),
            threads=os.environ.get("OMP_NUM_THREADS"),
            command=Path("/proc/self/cmdline").read_bytes(),
            modules=sorted(sys.modules),
            directory=str(Path.cwd()),
        )

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=0.0)


class Names(Environment):
    """Fields that differ between the instances."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields((f"x{self.instance_id}", float))

    def step(self):
        self.set_training_data(**{f"x{self.instance_id}": 1.0})


class Faulty(Plain):
    """Breaks in one way at one place: a method, or ``prediction`` for while it waits for one.

    Each instance leaves a child process running. Before it breaks, it says so on its standard
    error, and writes the time into the file ``broke``.
    """

    def __init__(self, *, fault: str, place: str, who: int = 2, at: int = 5, **kwargs):
        super().__init__(**kwargs)
        self.fault, self.place, self.who, self.at = fault, place, who, at
        subprocess.Popen(["sleep", "600"])

    def create(self):
        self.reach("create")

    def init_database(self):
        super().init_database()
        self.reach("init_database")

    def act(self):
        if self.step_index != self.at:
            return
        self.reach("step")
        if self.place == "prediction":
            self.wait_for_prediction()

    def wait_for_prediction(self):
        if self.instance_id == self.who:
            signal.signal(signal.SIGALRM, lambda *args: self.reach("prediction"))
            signal.setitimer(signal.ITIMER_REAL, 0.1)
        else:
            sleep(0.5)  # requests are answered together: the other one waits for this one
        self.get_prediction(x=np.zeros(2))

    def close(self):
        self.reach("close")

    def reach(self, place):
        if place == self.place and self.instance_id == self.who:
            print("last words", file=sys.stderr, flush=True)
            Path("broke").write_text(str(time.monotonic()))
            getattr(self, f"do_{self.fault}")()

    def do_raise(self):
        raise RuntimeError("no more beans")

    def do_exit(self):
        os._exit(3)

    def do_kill(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def do_stop(self):
        os.kill(os.getpid(), signal.SIGSTOP)

    def do_nothing(self):
        """All is well."""

    def do_hold(self):
        ctypes.PyDLL(None).pause()  # a call that does not let Python's other threads run

    def do_spin(self):
        while True:
            pass

    def do_garbage(self):
        own_connection().sendall(bytes(range(1, 256)) * 20)
        sleep(60)

    def do_half(self):
        own_connection().sendall(struct.pack("<IHHQ", 1000, 8, 0, 1) + bytes(500))
        sleep(60)

    def do_dribble(self):
        connection = own_connection()
        connection.sendall(struct.pack("<IHHQ", 1000, 8, 0, 1))
        for _ in range(600):
            sleep(0.1)
            connection.sendall(b"x")

    def do_trickle(self):
        connection = own_connection()
        connection.sendall(struct.pack("<IHHQ", 1_000_000, 8, 0, 1))
        for _ in range(600):
            sleep(0.1)
            connection.sendall(bytes(200))

    def do_disconnect(self):
        own_connection().shutdown(socket.SHUT_RDWR)
        sleep(60)


def own_connection():
    """The client's connection to its server, found among the open files of the process."""
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found = socket.socket(fileno=os.dup(int(entry.name)))
            found.getpeername()
            found.setblocking(True)
            return found
    raise RuntimeError("there is no connection")
