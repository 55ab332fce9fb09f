"""A two-wheeled robot that senses obstacles, and apples that nothing hides, with rays."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_remote import RLAgent, fill
from physx_sim import JointSettings, Robot

RAYS = 16
NEAR, FAR = 0.4, 6.0  # where rays start and end, in m from the robot's center
EYE = 0.2  # height of the rays, in m
SPEED = 12.0  # of a wheel, in rad/s
WHEELS = ("left_wheel_joint", "right_wheel_joint")
ANGLES = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
SEEN = spaces.Box(0.0, FAR, (RAYS,), np.float32)


class Seeker(RLAgent):
    """Drives with its wheels; reports the distances to obstacles and apples in each direction."""

    ROBOT = Robot(
        "wheeled_base",
        fixed_base=False,
        position=(-1.5, 0.0, 0.15),
        joints=dict.fromkeys(WHEELS, JointSettings(mode="servo")),
    )
    FIELDS = (Field("obstacles", (RAYS,), "float32"), Field("apples", (RAYS,), "float32"))
    OBSERVATIONS = spaces.Dict({"obstacles": SEEN, "apples": SEEN})
    ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, simulation, world):
        self.simulation, self.world = simulation, world
        joints = simulation.layout.joints
        self.wheels = [i for i, j in enumerate(joints) if str(j).rpartition("/")[2] in WHEELS]
        self.commands = np.zeros(len(joints))

    def set_action(self, action):
        self.commands[self.wheels] = SPEED * np.clip(np.asarray(action, float), -1.0, 1.0)
        self.simulation.set_commands(self.commands)

    def pose(self):
        """Return x and y in m, shape (2,), and the heading in rad."""
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
        for x, y in self.world.apples[~self.world.eaten] - place:
            ray = round((np.arctan2(y, x) - heading) / (2 * np.pi / RAYS)) % RAYS
            if (distance := np.hypot(x, y)) < obstacles[ray]:
                apples[ray] = min(apples[ray], distance)
        fill(storage, obstacles=obstacles, apples=apples)
