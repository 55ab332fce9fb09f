"""A walled room with apples through which another process can drive a robot."""

from __future__ import annotations

import numpy as np
from environments.seeker import Seeker

from physx_core import Field, plugins
from physx_remote import Messages, RLEnvironment, RLEnvWorld, fill
from physx_sim import Box, Ground, World

SIZE, HEIGHT, THICK = 6.0, 0.5, 0.1  # of the room and its walls, in m
APPLES = 5
REACH = 0.45  # distance at which an apple is found, in m
PLACES = {
    "north": ((0.0, SIZE / 2), (SIZE, THICK)),
    "south": ((0.0, -SIZE / 2), (SIZE, THICK)),
    "east": ((SIZE / 2, 0.0), (THICK, SIZE)),
    "west": ((-SIZE / 2, 0.0), (THICK, SIZE)),
    "pillar": ((0.0, 0.0), (0.6, 0.6)),
}
WALLS = [
    Box(name=name, static=True, position=(*place, HEIGHT / 2), size=(*size, HEIGHT))
    for name, (place, size) in PLACES.items()
]
SHOWN = Field("places", (APPLES, 2)), Field("eaten", (APPLES,), bool), Field("poses", (5, 7))


class Apples(RLEnvWorld):
    """The apples, the result of the last action, and the robot's body poses for pictures."""

    FIELDS = (("reward", float), ("terminated", bool), *SHOWN)

    def __init__(self, simulation):
        self.simulation, self.reward = simulation, 0.0

    def scatter(self, rng):
        """Scatter the apples, and return a free place for the robot."""
        places = []
        while len(places) <= APPLES:
            place = rng.uniform(0.6 - SIZE / 2, SIZE / 2 - 0.6, 2)
            if np.abs(place).max() > 0.9 and all(np.hypot(*(place - p)) > 0.8 for p in places):
                places.append(place)
        self.apples, self.eaten, self.reward = np.array(places[1:]), np.zeros(APPLES, bool), 0.0
        return places[0]

    def eat(self, place):
        near = np.linalg.norm(self.apples - place, axis=1) <= REACH
        self.reward, self.eaten = float((near & ~self.eaten).sum()), self.eaten | near

    def get_data(self, request, storage):
        told = {"places": self.apples, "eaten": self.eaten, "poses": self.simulation.body_poses()}
        fill(storage, reward=self.reward, terminated=self.eaten.all(), **told)


class AppleSeeker(RLEnvironment):
    """Find all apples. Action: the speeds of both wheels, in [-1, 1]."""

    def _ready(self):
        world = World([Seeker.ROBOT], objects=WALLS, ground=Ground(), period=1 / 240)
        self.simulation = plugins.resolve("backend", "dart").build(world)
        self.begin = self.simulation.positions()
        self.world = Apples(self.simulation)
        self.agent = Seeker(self.simulation, self.world)
        self.messages = Messages.of_fields(agent=Seeker.FIELDS, world=Apples.FIELDS)
        self.observation_space, self.action_space = Seeker.OBSERVATIONS, Seeker.ACTIONS

    def _reset(self):
        turn = self.rng.uniform(-np.pi, np.pi)
        place = self.world.scatter(self.rng)
        facing = 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)
        positions = np.concatenate([place, self.begin[2:3], facing, self.begin[7:]])
        self.simulation.set_state(positions, np.zeros(self.simulation.layout.nv))
        self.agent.set_action([0.0, 0.0])

    def _step(self, action):
        yield from super()._step(action)
        self.world.eat(self.agent.pose()[0])
