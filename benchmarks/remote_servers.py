"""Servers for remote.py: a small scene on DART, and raw sockets that run the same physics."""

from __future__ import annotations

import socket
import sys
from typing import Any

import numpy as np

from physx_core import Field, plugins
from physx_remote import Messages, RLAgent, RLEnvironment, RLEnvWorld
from physx_remote.godot_gym.messages import fill
from physx_sim import Ground, JointSettings, Robot, Simulation, World

FRAME = 1 / 60
WHEELS = ("left_wheel_joint", "right_wheel_joint")
VALUES = 16
ACTION = [2.0, 3.0]


def build(frame_steps: int) -> Simulation:
    """Return the robot of examples/13_remote_world.py on the ground, on DART.

    Args:
        frame_steps: Number of physics steps in a frame of 1/60 s.
    """
    joints = dict.fromkeys(WHEELS, JointSettings(mode="servo"))
    robot = Robot("wheeled_base", fixed_base=False, position=(0.0, 0.0, 0.15), joints=joints)
    world = World([robot], ground=Ground(), period=FRAME / frame_steps)
    simulation: Simulation = plugins.resolve("backend", "dart").build(world)
    return simulation


class Wheels(RLAgent):
    """A robot on wheels that reports its position and velocity, padded with zeros."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        joints = simulation.layout.joints
        self.wheels = [joints.index(wheel) for wheel in WHEELS]
        self.commands = np.zeros(len(joints))
        self.positions, self.velocities = np.zeros(VALUES), np.zeros(VALUES)

    def set_action(self, action: Any) -> None:
        """Turn the wheels."""
        self.commands[self.wheels] = action
        self.simulation.set_commands(self.commands)

    def get_data(self, request: Any, storage: Any) -> None:
        """Report the state, 16 + 16 numbers."""
        layout = self.simulation.layout
        self.simulation.positions(self.positions[: layout.nq])
        self.simulation.velocities(self.velocities[: layout.nv])
        fill(storage, positions=self.positions, velocities=self.velocities)


class Room(RLEnvWorld):
    """Reports that it is not over."""

    def get_data(self, request: Any, storage: Any) -> None:
        """Report that it is not over."""
        fill(storage, done=False)


class Small(RLEnvironment):
    """The small scene."""

    def __init__(self, steps: int = 1) -> None:
        super().__init__()
        self.frame_steps = steps

    def _ready(self) -> None:
        self.simulation = build(self.frame_steps)
        self.begin = self.simulation.snapshot()
        self.agent, self.world = Wheels(self.simulation), Room()
        self.messages = messages()

    def _reset(self) -> None:
        if self.simulation is not None:
            self.simulation.set_state(self.begin.positions, self.begin.velocities)


def messages() -> Messages:
    """Return the scene's messages: 16 + 16 numbers and a boolean."""
    agent = [Field(name, (VALUES,), "float32") for name in ("positions", "velocities")]
    return Messages.of_fields(agent=agent, world=[("done", bool)])


def main() -> None:
    """Answer each request of a given size with an answer of a given size, after a physics frame."""
    request, answer, steps = (int(word) for word in sys.argv[1:])
    simulation, reply = build(steps or 1), bytes(answer)
    Wheels(simulation).set_action(ACTION)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        print(listener.getsockname()[1], flush=True)
        connection, _ = listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    received = 0
    while data := connection.recv(1 << 16):
        received += len(data)
        if received == request:
            received = 0
            if steps:
                simulation.step(steps)
            connection.sendall(reply)


if __name__ == "__main__":
    main()
