"""Servers for remote.py: a small scene on DART, and raw sockets that make the same physics."""

from __future__ import annotations

import socket
import sys
from typing import Any

from physx_core import Field, Simulation, plugins
from physx_core.remote import Messages, RLAgent, RLEnvironment, RLEnvWorld
from physx_core.remote.messages import fill
from physx_core.world import Ground, Sphere, World, Wrench

PERIOD = 1 / 120
FRAME_STEPS = 2
VALUES = 16


def build() -> Simulation:
    """Return a ball on the ground, on DART."""
    ball = Sphere(name="ball", radius=0.1, position=(0.0, 0.0, 0.1))
    world = World(objects=[ball], ground=Ground(), period=PERIOD)
    simulation: Simulation = plugins.resolve("backend", "dart").build(world)
    return simulation


class Ball(RLAgent):
    """A ball that is pushed; it tells its position and velocity, and some numbers more."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.number = simulation.apply_wrench(Wrench("ball"))
        self.rest = [0.0] * VALUES

    def set_action(self, action: Any) -> None:
        """Push the ball."""
        self.simulation.remove_wrench(self.number)
        self.number = self.simulation.apply_wrench(Wrench("ball", force=action))

    def get_data(self, request: Any, storage: Any) -> None:
        """Tell what there is, 16 + 16 numbers."""
        positions = self.simulation.positions().tolist() + self.rest
        velocities = self.simulation.velocities().tolist() + self.rest
        fill(storage, positions=positions[:VALUES], velocities=velocities[:VALUES])


class Room(RLEnvWorld):
    """Tells that it is not over."""

    def get_data(self, request: Any, storage: Any) -> None:
        """Tell that it is not over."""
        fill(storage, done=False)


class Small(RLEnvironment):
    """The small scene."""

    def _ready(self) -> None:
        self.simulation = build()
        self.begin = self.simulation.snapshot()
        self.agent, self.world = Ball(self.simulation), Room()
        self.messages = messages()

    def _reset(self) -> None:
        if self.simulation is not None:
            self.simulation.set_state(self.begin.positions, self.begin.velocities)


def messages() -> Messages:
    """Return the scene's messages: 16 + 16 numbers and a boolean."""
    agent = [Field(name, (VALUES,), "float32") for name in ("positions", "velocities")]
    return Messages.of_fields(agent=agent, world=[("done", bool)])


def main() -> None:
    """Answer each request of so many bytes with so many bytes, after one frame of physics."""
    request, answer, steps = (int(word) for word in sys.argv[1:])
    simulation, reply = build(), bytes(answer)
    simulation.apply_wrench(Wrench("ball", force=(0.1, 0.0, 0.0)))
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
