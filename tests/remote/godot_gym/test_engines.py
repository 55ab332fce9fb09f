"""RLEnvironment over an engine: the same in process and over godot-gym."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core import Field, plugins
from physx_remote import Messages, RLAgent, RLEnvironment, RLEnvWorld
from physx_remote.godot_gym.messages import fill
from physx_sim import Robot, World

pytestmark = pytest.mark.filterwarnings("ignore:.*Box:UserWarning")


class Cart(RLAgent):
    def __init__(self, simulation):
        self.simulation = simulation

    def set_action(self, action):
        self.simulation.set_torques(np.array([action[0], 0.0]))

    def get_data(self, request, storage):
        q, v = self.simulation.positions(), self.simulation.velocities()
        fill(storage, state=np.concatenate([q, v]))


class Track(RLEnvWorld):
    def __init__(self, simulation):
        self.simulation = simulation

    def get_data(self, request, storage):
        slider = self.simulation.positions()[0]
        fill(storage, reward=1.0, terminated=bool(abs(slider) > 0.2), slider=slider)


class CartPole(RLEnvironment):
    """A cart with a pole on an engine; one physics step in a frame."""

    def __init__(self, backend="dart"):
        super().__init__()
        self.backend = backend

    def _ready(self):
        world = World(robots=[Robot("cartpole")], period=1 / 60)
        self.simulation = plugins.resolve("backend", self.backend).build(world)
        self.agent, self.world = Cart(self.simulation), Track(self.simulation)
        self.messages = Messages.of_fields(
            agent=[Field("state", (4,))],
            world=[("reward", float), ("terminated", bool), ("slider", float)],
        )
        self.action_space = spaces.Box(-10, 10, (1,), np.float64)

    def _reset(self):
        self.simulation.set_state(self.rng.uniform(-0.05, 0.05, 2), self.rng.uniform(-1, 1, 2))


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_the_same_trajectory_on_an_engine(drive, same, backend):
    env = drive(CartPole(backend), repeat_action=2)
    world = World(robots=[Robot("cartpole")], period=1 / 60)
    with plugins.resolve("backend", backend).build(world) as simulation:
        for seed in (1, 2, 1):
            rng = np.random.default_rng(seed)
            simulation.set_state(rng.uniform(-0.05, 0.05, 2), rng.uniform(-1, 1, 2))
            observation, _ = env.reset(seed=seed)
            env.action_space.seed(seed)
            for _ in range(25):
                state = np.concatenate([simulation.positions(), simulation.velocities()])
                assert same(observation["state"], state)
                action = env.action_space.sample()
                simulation.set_torques(np.array([action[0], 0.0]))
                simulation.step(2)
                observation, reward, terminated, truncated, info = env.step(action)
                assert (reward, truncated) == (1.0, False)
                assert terminated == (abs(simulation.positions()[0]) > 0.2)
                assert info == {"slider": simulation.positions()[0]}


def test_the_checker_of_gymnasium_on_an_engine(drive):
    check_env(drive(CartPole()), skip_render_check=True)


@pytest.mark.parametrize(("period", "steps"), [(1 / 60, 1), (1 / 240, 4), (1e-3, 17), (0.05, 1)])
def test_how_many_physics_steps_a_frame_has(start, peer_class, period, steps):
    class Free(CartPole):
        def _ready(self):
            world = World(robots=[Robot("cartpole")], period=period)
            self.simulation = plugins.resolve("backend", self.backend).build(world)
            self.agent, self.world = Cart(self.simulation), Track(self.simulation)

    service = start(Free())
    peer = peer_class(service.address, service)
    assert service.environment.frame_time == steps * period
    for frames in (0, 1, 4, 10):
        before = service.environment.simulation.frame
        peer.ask({"config": {"environment": {"repeat_action": frames}}})
        peer.ask({"action": [0]})
        service.poll(0.01)
        assert service.environment.simulation.frame - before == frames * steps
    service.environment.frame_steps = 3
    peer.ask({"action": [0]})
    assert service.environment.simulation.frame - before == 10 * steps + 30
    peer.leave()


def test_steps_of_ones_own(start, scene_class, peer_class):
    class Before(scene_class):
        def _step(self, action):
            self.calls.append(("before", self.agent.frames))
            yield from super()._step(action)
            self.calls.append(("behind", self.agent.frames))

    class Instead(scene_class):
        async def _step(self, action):
            self.calls.append(("before", self.agent.frames))
            self.agent.set_action(action)
            await self.physics_frames_timer.start()  # paused: nothing moves
            self.paused = False
            await self.physics_frames_timer.start()
            self.paused = True
            self.calls.append(("behind", self.agent.frames))

    class Plain(scene_class):
        def _step(self, action):
            self.calls += [("before", 0), ("behind", 4)]

    for kind in (Before, Instead, Plain):
        service = start(kind())
        peer = peer_class(service.address, service)
        peer.ask({"action": [1]})
        calls = service.environment.calls
        assert [call for call in calls if call[0] != "set_action"][:2] == [
            ("before", 0),
            ("behind", 4),
        ]
        assert service.environment.paused
        peer.leave()


def test_an_environment_is_also_known_by_its_reference(start, tmp_path, monkeypatch):
    text = "from physx_remote import RLEnvironment\n\n\nclass Room(RLEnvironment):\n"
    script = tmp_path / "room.py"
    script.write_text(text + "    def _ready(self):\n        self.messages = None\n")
    service = start(f"{script}:Room")
    assert type(service.environment).__name__ == "Room"
