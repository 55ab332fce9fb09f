"""Starts processes of one kind, and ends in one way: owner.py KIND WAY.

It prints "ready" when they run, "skip" and why if they cannot, and ends when it may read a line.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from physx_core import DataGeneration, Environment, EnvironmentConfig, plugins
from physx_core.components import Factory
from physx_core.errors import VisualizerError
from physx_core.processes import ChildProcess
from physx_sim import Robot, World

kept = []


class Nested(Environment):
    """An environment with a process of its own."""

    def create(self):
        self.process = ChildProcess(["sleep", "1000"])

    def init_database(self):
        self.define_training_fields([("x", np.ndarray)])

    def step(self):
        self.set_training_data(x=np.ones(1))


def clients():
    config = EnvironmentConfig(Nested, num_clients=2)
    pipeline = DataGeneration(config, batch_nb=1, batch_size=2)
    kept.append(pipeline.__enter__())


def vector():
    from physx_gym import ParallelVectorEnv

    env = ParallelVectorEnv("CartPole-v1", 4, num_processes=2)
    env.reset(seed=0)
    kept.append(env)


def batches():
    backend = plugins.resolve("backend", "pinocchio")
    simulation = backend.build(World([Robot("double_pendulum")]))
    simulation.forward_dynamics_batch(*np.zeros((3, 64, 2)), processes=3)
    kept.append(simulation)


def drawn(**options):
    visualizer = plugins.resolve("visualizer", "rerun")(**options)
    visualizer.open("run", Path.cwd(), 1)
    factory = Factory()
    factory.add_points("points", np.zeros((4, 3)))
    visualizer.events(1, 0, factory.take_events())
    return visualizer


def pictures():
    visualizer = drawn(mode="offscreen", save=False, picture_size=(96, 64))
    visualizer.capture()
    kept.append(visualizer)


def headless():
    visualizer = drawn(mode="headless", picture_size=(96, 64))
    threading.Thread(target=visualizer.close, daemon=True).start()
    while not any(b"--headless" in command for command in commands()):
        time.sleep(0.01)


def tensorboard():
    from physx_core.cli import main

    Path("session/stats/tensorboard").mkdir(parents=True)
    words = ["stats", "session", "--tensorboard", "--port", "0"]
    threading.Thread(target=main, args=(words,), daemon=True).start()
    while not any(b"tensorboard.main" in command for command in commands()):
        time.sleep(0.01)


def commands():
    for path in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
        try:
            if int((path.parent / "stat").read_text().rpartition(")")[2].split()[1]) == os.getpid():
                yield path.read_bytes()
        except OSError:
            continue


def end(way):
    if way == "exception":
        raise RuntimeError("on purpose")
    if way == "sys.exit":
        sys.exit(3)
    if way in ("SIGTERM", "SIGKILL"):
        os.kill(os.getpid(), getattr(signal, way))
        time.sleep(60)
    if way == "os._exit":
        os._exit(4)


if __name__ == "__main__":
    try:
        globals()[sys.argv[1]]()
    except VisualizerError as error:
        print("skip", str(error), flush=True)
        os._exit(0)
    print("ready", flush=True)
    sys.stdin.readline()
    end(sys.argv[2])
