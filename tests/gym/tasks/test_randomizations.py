"""Domain randomization: what is drawn is what is simulated, from the seed, and in the log."""

import copy

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from physx_core import plugins
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_gym import (
    ComposedEnv,
    PDController,
    RandomizedEnv,
    RobotEnv,
    Simulator,
    build_pipeline,
    load_pipeline,
    read_log,
)
from physx_gym.env.layers.block_layers import ControlledEnv
from physx_gym.tasks.randomizations import (
    RandomDelays,
    RandomFriction,
    RandomGains,
    Randomization,
    RandomMasses,
    RandomNoise,
    RandomPushes,
)
from physx_sim import Encoder, Ground, Robot, Sphere, World

TABLE = """
env_config.cls = "RobotEnv"
env_config.kwargs.step_dt = 0.02
env_config.kwargs.simulator.cls = "physx_gym:Simulator.build"
env_config.kwargs.simulator.kwargs = {urdf = "ant", fixed_base = false, control_period = 0.01, period = 0.005}
[[layers_config]]
block = {cls = "PDController", name = "pd", kwargs = {kp = 30.0, kd = 0.02, joint_acceleration_limit = 200.0}}
[[layers_config]]
wrapper.cls = "RandomizedEnv"
wrapper.kwargs.randomizations = [
  {cls = "RandomMasses", kwargs = {factor = [0.8, 1.2]}},
  {cls = "RandomFriction", kwargs = {coefficient = [0.4, 1.0]}},
  {cls = "RandomGains", kwargs = {kp = [0.9, 1.1], kd = [0.5, 2.0]}},
  {cls = "RandomDelays", kwargs = {delay = [0.0, 0.01]}},
  {cls = "RandomNoise", kwargs = {deviation = {position = [0.0, 0.01], velocity = [0.0, 0.1]}}},
  {cls = "RandomPushes", kwargs = {force = [10.0, 50.0], every = [0.05, 0.1], until = 2.0}},
]
"""  # noqa: E501 - a file


@pytest.fixture
def make(tmp_path):
    path = tmp_path / "walker.toml"
    path.write_text(TABLE, encoding="utf-8")
    return load_pipeline(path)


def ant(**options):
    return RobotEnv("ant", 0.02, fixed_base=False, period=5e-3, **options)


def controlled(env, name="pd"):
    block = PDController(name, env, kp=30.0, kd=0.02, joint_acceleration_limit=200.0)
    return ControlledEnv(env, block)


def actions(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def plays(env, given):
    return [env.step(action)[0] for action in given]


# All of them ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_seed_and_number_of_the_episode_determine_everything(make, backend):
    env, twin = make(backend=backend), make(backend=backend)
    given = actions(env, 5)
    drawn, seen = [], []
    for seed in (3, None, None):
        first = env.reset(seed=seed)[0]
        drawn.append(copy.deepcopy(env.drawn))
        seen.append([first, *plays(env, given)])
    assert drawn[0] != drawn[1] != drawn[2]
    assert env.drawn.keys() == {each.name for each in env.randomizations}
    for seed in (8, 9):
        twin.reset(seed=seed)
        plays(twin, given)
    for seed, values, observations in zip((3, None, None), drawn, seen, strict=True):
        first = twin.reset(seed=seed)[0]
        assert twin.drawn == values
        np.testing.assert_equal([first, *plays(twin, given)], observations)


@pytest.mark.slow
def test_snapshots_and_copies_keep_what_was_drawn(make, backend):
    env = make(backend=backend)
    given = actions(env, 10)
    env.reset(seed=3)
    plays(env, given[:5])
    state, drawn = env.snapshot(), copy.deepcopy(env.drawn)
    twin = copy.deepcopy(env)
    expected = plays(env, given[5:])
    np.testing.assert_equal(plays(twin, given[5:]), expected)
    env.reset()
    second = copy.deepcopy(env.drawn)
    for other in (env, twin, make(backend=backend)):
        other.restore(state)
        assert other.drawn == drawn
        np.testing.assert_equal(plays(other, given[5:]), expected)
        other.reset()
        assert other.drawn == second


def test_the_first_states_are_those_without_the_layer():
    class Thrown(RobotEnv):
        def _sample_state(self):
            return self._neutral(), self.np_random.normal(size=14)

    bare = Thrown("ant", 0.02, fixed_base=False)
    env = RandomizedEnv(
        Thrown("ant", 0.02, fixed_base=False), randomizations=RandomMasses([0.5, 2.0])
    )
    for seed in (5, None, None):
        np.testing.assert_equal(env.reset(seed=seed)[0], bare.reset(seed=seed)[0])


def test_what_was_drawn_is_in_the_log(make, tmp_path):
    env = make()
    env.reset(seed=1)
    env.step(actions(env, 1)[0])
    assert env.log_data["constants"]["randomization"] == env.drawn
    env.stop()
    env.eval()
    env.reset(options={"log_path": tmp_path / "a.h5"})
    env.step(actions(env, 1)[0])
    env.stop()
    log = read_log(tmp_path / "a.h5")
    assert log.constants["randomization"] == env.drawn
    factors = env.drawn["RandomMasses"]
    assert log.constants["options"]["world"]["robots"]["robot"]["mass_factors"] == factors
    assert log.world().robots[0].mass_factors == factors


def test_several_episodes_may_share_what_is_drawn():
    env = RandomizedEnv(ant(), randomizations=[RandomFriction([0.1, 1.0])], every=3)
    found = []
    for number in range(7):
        env.reset(seed=2 if number == 0 else None)
        found.append(env.drawn["RandomFriction"]["coefficient"])
    assert found == [found[0]] * 3 + [found[3]] * 3 + [found[6]]
    assert len(set(found)) == 3
    env.reset(seed=2)
    assert env.drawn["RandomFriction"]["coefficient"] == found[0]


def test_layers_go_below_and_above():
    env = ComposedEnv(RandomizedEnv(controlled(ant()), randomizations=[RandomGains(kp=[0.5, 2])]))
    env.reset(seed=0)
    before = copy.deepcopy(env.drawn)
    state = env.snapshot()
    env.reset()
    assert env.drawn != before
    env.restore(state)
    assert env.drawn == before


@pytest.mark.filterwarnings("ignore:.*(bounds|space|unwrapped).*")
def test_gymnasiums_checker_passes():
    table = {"cls": "RandomMasses", "kwargs": {"factor": [0.9, 1.1]}}
    layer = {"wrapper": {"cls": "RandomizedEnv", "kwargs": {"randomizations": [table]}}}
    check_env(build_pipeline({"cls": "physx/Ant-v0"}, [layer])(), skip_render_check=True)


# Each of them -----------------------------------------------------------------------------------


def test_masses_are_multiplied(backend):
    world = World([Robot("ant", fixed_base=False, mass_factors={"torso": 2.0})], contacts="static")
    env = RobotEnv(world, 0.02, backend=backend)
    nominal = env.simulator.simulation.mass_matrix(env.simulator.positions)
    env = RandomizedEnv(env, randomizations=RandomMasses([0.5, 0.5]))
    env.reset(seed=0)
    halved = env.simulator.simulation.mass_matrix(env.simulator._built().first.positions)
    np.testing.assert_allclose(halved, 0.5 * nominal, rtol=1e-9, atol=1e-12)
    assert env.simulator.world.robots[0].mass_factors["torso"] == 1.0
    env.reset()
    assert env.simulator.world.robots[0].mass_factors["torso"] == 1.0


def test_a_link_and_an_object_may_be_chosen():
    ball = Sphere(name="ball", radius=0.1, mass=2.0)
    env = RobotEnv(World([Robot("cartpole")], objects=[ball]), 0.02)
    env = RandomizedEnv(env, randomizations=RandomMasses([3.0, 3.0], of=["pole", "ball"]))
    env.reset(seed=0)
    world = env.simulator.world
    assert world.objects[0].mass == 6.0
    assert world.robots[0].mass_factors == {"pole": 3.0}


@pytest.mark.parametrize("of", [None, ["ground"], ["ball", "robot"]])
def test_friction_is_that_of_everything_chosen(of):
    ball = Sphere(name="ball", radius=0.1, position=(3.0, 0.0, 0.1), friction=0.9)
    env = ant(objects=[ball])
    env = RandomizedEnv(env, randomizations=[RandomFriction([0.2, 0.3], of)])
    env.reset(seed=0)
    world, drawn = env.simulator.world, env.drawn["RandomFriction"]["coefficient"]
    assert 0.2 <= drawn <= 0.3
    found = {"ground": world.ground, "robot": world.robots[0], "ball": world.objects[0]}
    chosen = found if of is None else of
    assert {name for name, each in found.items() if each.friction == drawn} == set(chosen)


def test_gains_are_multiplied():
    first, second = controlled(ant()), controlled(ant())
    second = RandomizedEnv(second, randomizations=RandomGains(kp=[2, 2], kd=[2, 2]))
    one, two = np.zeros(8), np.zeros(8)
    for env, command in ((first, one), (second, two)):
        env.reset(seed=0)
        env.compute_command(np.full(8, 50.0), env.robot_state.command)
        command[:] = env.robot_state.command
    assert np.abs(one).min() > 0
    np.testing.assert_allclose(two, 2 * one)


def test_delays_and_noise_are_those_of_the_sensors(backend):
    sensors = [
        Encoder(name="a", joint="slider", noise=0.5),
        Encoder(name="b", joint="slider", noise={"position": 0.25}),
    ]
    env = RobotEnv("cartpole", 0.02, sensors=sensors, backend=backend)
    noise = RandomNoise({"velocity": [0.1, 0.2]})
    env = RandomizedEnv(env, randomizations=[RandomDelays([0.02, 0.03], ["b"]), noise])
    env.reset(seed=0)
    first, second = env.simulator.sensors
    assert (first.delay, second.delay) == (0.0, env.drawn["RandomDelays"]["b"])
    assert 0.02 <= second.delay <= 0.03
    drawn = env.drawn["RandomNoise"]
    assert first.noise == {"position": 0.5, "velocity": drawn["a"]["velocity"]}
    assert second.noise == {"position": 0.25, "velocity": drawn["b"]["velocity"]}
    assert 0.1 <= drawn["a"]["velocity"] <= 0.2


def test_pushes_change_the_momentum():
    ball = Sphere(name="ball", radius=0.1, mass=2.0)
    env = RobotEnv(World([Robot("cartpole")], objects=[ball]), 0.02, simulation_duration_max=1.0)
    pushes = RandomPushes([5.0, 9.0], every=[0.05, 0.15], duration=0.01, body="ball")
    env = RandomizedEnv(env, randomizations=pushes)
    for seed in (0, None):
        env.reset(seed=seed)
        drawn = env.drawn["RandomPushes"]
        times, forces = np.array(drawn["times"]), np.array(drawn["forces"])
        assert (np.diff(times) >= 0.05).all() and (np.diff(times) <= 0.15).all()
        assert (np.linalg.norm(forces, axis=1) >= 5.0).all()
        assert not forces[:, 2].any()
        while not env.step([0.0, 0.0])[3]:
            pass
        [velocity] = env.simulator.simulation.body_velocities(["ball"])
        impulse = 0.01 * forces[times < 0.985].sum(axis=0)
        if times[-1] < 0.985:  # the last is over
            np.testing.assert_allclose(2.0 * velocity[:2], impulse[:2], rtol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (lambda: RandomMasses([1.2, 0.8]), ConfigError, r"factor is \[1.2, 0.8\] but must be"),
        (lambda: RandomMasses([0.0, 0.8]), ConfigError, "not below"),
        (lambda: RandomFriction(0.5), ConfigError, "needs 2 numbers"),
        (lambda: RandomNoise(0.5), ConfigError, "mapping of quantities to ranges"),
        (lambda: RandomPushes([0, 1], every=[0.0, 1.0]), ConfigError, "not below 0.001"),
        (lambda: RandomMasses([1, 2], of=["torsoo"]), ComponentNotFoundError, '"torso"'),
        (lambda: RandomFriction([1, 2], of=["grund"]), ComponentNotFoundError, '"ground"'),
        (lambda: RandomDelays([0, 1], ["torsoo"]), ComponentNotFoundError, '"torso"'),
        (lambda: RandomNoise({"positon": [0, 1]}), ComponentNotFoundError, '"position"'),
        (lambda: RandomPushes([0, 1], [1, 2], body="torsoo"), ComponentNotFoundError, '"torso"'),
        (lambda: RandomGains(), ConfigError, "needs exactly one PDController below it"),
        (lambda: RandomGains(block="pd"), ComponentNotFoundError, "pd"),
        (lambda: "RandomMasses", ConfigError, "is not a Randomization"),
    ],
)
def test_mistakes_are_named_when_the_layer_is_made(wrong, error, message):
    with pytest.raises(error, match=message):
        RandomizedEnv(ant(), randomizations=[wrong()])


def test_layers_that_do_not_fit_together():
    masses = RandomMasses([1, 2])
    with pytest.raises(ConfigError, match="the same name"):
        RandomizedEnv(ant(), randomizations=[masses, masses])
    with pytest.raises(ConfigError, match="already has a RandomizedEnv"):
        RandomizedEnv(RandomizedEnv(ant(), randomizations=masses), randomizations=masses)
    with pytest.raises(ConfigError, match="every is 0 but must be a number of episodes"):
        RandomizedEnv(ant(), randomizations=masses, every=0)


def test_own_randomizations():
    class Tilted(Randomization):
        """Gravity along another direction."""

        def draw(self, nominal, random):
            return {"angle": random.uniform(-0.2, 0.2)}

        def options(self, nominal, drawn):
            angle = drawn["angle"]
            return {"world": {"gravity": (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))}}

    env = RandomizedEnv(ant(), randomizations=[Tilted("slope")])
    env.reset(seed=0)
    assert env.simulator.world.gravity[0] == 9.81 * np.sin(env.drawn["slope"]["angle"])


def test_the_friction_of_the_file_returns(backend):
    for described, builds in ((None, 1), (0.25, 2)):
        robot = Robot("ant", fixed_base=False, friction=described)
        simulator = Simulator(World([robot], ground=Ground()), backend=backend)
        simulator.prepare()
        for friction, found in ((0.5, 0.5), (None, 1.0)):
            simulator.set_options({"world": {"robots": {"robot": {"friction": friction}}}})
            simulator.prepare()
            shapes = simulator.simulation.parts.movables[0].model.shapes
            assert {shape.friction for shape in shapes} == {found}
        assert simulator.builds == builds


def test_masses_and_friction_change_without_a_build(backend):
    given = [RandomMasses([0.5, 2.0]), RandomFriction([0.4, 1.0])]
    env = RandomizedEnv(ant(backend=backend), randomizations=given)
    base, totals = env.unwrapped, set()
    for number in range(3):
        env.reset(seed=number)
        world, factors = base.simulator.world, env.drawn["RandomMasses"]
        assert base.simulator.builds == 1
        assert world.ground.friction == env.drawn["RandomFriction"]["coefficient"]
        assert world.robots[0].mass_factors == factors
        rebuilt = plugins.resolve("backend", backend).build(world)
        simulation = base.simulator.simulation
        q = simulation.positions()
        np.testing.assert_allclose(
            simulation.mass_matrix(q), rebuilt.mass_matrix(q), rtol=1e-12, atol=1e-14
        )
        totals.add(simulation.mass_matrix(q)[0, 0])
    assert len(totals) == 3
