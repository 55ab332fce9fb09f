"""A walled room with apples and a robot on two wheels that looks for them, without a camera."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from physx_core import Field, plugins
from physx_core.simulation import Box, Ground, JointSettings, Robot, World
from physx_remote import Messages, RLAgent, RLEnvironment, RLEnvWorld
from physx_remote.godot_gym.messages import fill

SIZE = 6.0  # of the room, in m
RAYS = 16
NEAR, FAR = 0.4, 6.0  # where rays begin and end, in m from the robot's middle
EYE = 0.2  # height of the rays, in m
REACH = 0.45  # distance at which an apple is found, in m
SPEED = 12.0  # of a wheel, in rad/s
WHEELS = ("left_wheel_joint", "right_wheel_joint")
ANGLES = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)


def room() -> World:
    """Return the room and the robot."""
    half, thick, height = SIZE / 2, 0.1, 0.5
    long, across = (SIZE, thick, height), (thick, SIZE, height)
    places = {
        "north": ((0.0, half, height / 2), long),
        "south": ((0.0, -half, height / 2), long),
        "east": ((half, 0.0, height / 2), across),
        "west": ((-half, 0.0, height / 2), across),
        "pillar": ((0.0, 0.0, height / 2), (0.6, 0.6, height)),
    }
    walls = [Box(name=n, static=True, position=p, size=s) for n, (p, s) in places.items()]
    servo = JointSettings(mode="servo")
    robot = Robot(
        "wheeled_base",
        fixed_base=False,
        position=(-1.5, 0.0, 0.15),
        joints=dict.fromkeys(WHEELS, servo),
    )
    return World([robot], objects=walls, ground=Ground(), period=1 / 240)


class Seeker(RLAgent):
    """Drives with its wheels; sees walls by rays, and apples that no wall hides."""

    def __init__(self, simulation, world):
        self.simulation, self.world = simulation, world
        joints = simulation.layout.joints
        self.wheels = [i for i, j in enumerate(joints) if str(j).rpartition("/")[2] in WHEELS]
        self.commands = np.zeros(len(joints))

    def set_action(self, action):
        self.commands[self.wheels] = SPEED * np.clip(np.asarray(action, float), -1.0, 1.0)
        self.simulation.set_commands(self.commands)

    def pose(self):
        """Return x, y and the heading."""
        x, y, _, qx, qy, qz, qw = self.simulation.body_poses(["base"])[0]
        return np.array([x, y]), np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))

    def get_data(self, request, storage):
        place, heading = self.pose()
        angles = ANGLES + heading
        ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(RAYS)], axis=1)
        middle = [*place, EYE]
        hits = self.simulation.raycast(middle + NEAR * ways, middle + FAR * ways)
        obstacles = np.where(hits["hit"], NEAR + (FAR - NEAR) * hits["fraction"], FAR)
        apples = np.full(RAYS, FAR)
        for apple in self.world.apples:
            x, y = apple - place
            distance = np.hypot(x, y)
            ray = round((np.arctan2(y, x) - heading) / (2 * np.pi / RAYS)) % RAYS
            if distance < obstacles[ray]:
                apples[ray] = min(apples[ray], distance)
        fill(storage, obstacles=obstacles, apples=apples)


class Apples(RLEnvWorld):
    """The apples, and what became of the last action."""

    def __init__(self):
        self.apples, self.reward, self.number = [], 0.0, 5

    def configure(self, configuration):
        self.number = int(configuration["apples"])

    def scatter(self, rng):
        """Return a free place for the robot, after apples were put at others."""
        border = SIZE / 2 - 0.6
        places = []
        while len(places) <= self.number:
            place = rng.uniform(-border, border, 2)
            if np.abs(place).max() > 0.9 and all(np.hypot(*(place - p)) > 0.8 for p in places):
                places.append(place)
        self.apples, self.reward = places[1:], 0.0
        return places[0]

    def eat(self, place):
        left = [apple for apple in self.apples if np.hypot(*(apple - place)) > REACH]
        self.reward, self.apples = float(len(self.apples) - len(left)), left

    def get_data(self, request, storage):
        fill(storage, reward=self.reward, terminated=not self.apples, left=len(self.apples))


class AppleSeeker(RLEnvironment):
    """Find all apples. Action: the speed of both wheels, in [-1, 1]."""

    def _ready(self):
        self.simulation = plugins.resolve("backend", "dart").build(room())
        self.begin = self.simulation.positions()
        self.world = Apples()
        self.agent = Seeker(self.simulation, self.world)
        self.messages = Messages.of_fields(
            agent=[Field("obstacles", (RAYS,), "float32"), Field("apples", (RAYS,), "float32")],
            world=[("reward", float), ("terminated", bool), ("left", int)],
        )
        seen = spaces.Box(0.0, 2 * FAR, (RAYS,), np.float32)
        self.observation_space = spaces.Dict({"obstacles": seen, "apples": seen})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _reset(self):
        place = self.world.scatter(self.rng)
        turn = self.rng.uniform(-np.pi, np.pi)
        positions = self.begin.copy()
        positions[:2] = place
        positions[3:7] = 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)
        self.simulation.set_state(positions, np.zeros(self.simulation.layout.nv))
        self.agent.set_action([0.0, 0.0])

    def _step(self, action):
        yield from super()._step(action)
        self.world.eat(self.agent.pose()[0])
