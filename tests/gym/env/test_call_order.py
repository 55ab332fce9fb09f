"""The order of the calls in an episode."""

import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import ConfigError, EpisodeError
from physx_gym import Layer, RobotEnv
from physx_sim import Motor

HOOKS = (
    "_setup",
    "_sample_state",
    "_initialize_buffers",
    "_refresh_buffers",
    "refresh_observation",
    "compute_command",
    "has_terminated",
    "compute_reward",
    "_initialize_action_space",
    "_initialize_observation_space",
)


def traced(kind, word):
    """Return a class that notes the calls of its hooks, with the time in physics steps."""

    def noting(name):
        def call(self, *arguments):
            self.notes.append((word + name, self.stepper_state.iter))
            return getattr(super(made, self), name)(*arguments)

        return call

    made = type(f"Traced{kind.__name__}", (kind,), {name: noting(name) for name in HOOKS[:8]})
    return made


class Base(traced(RobotEnv, "")):
    def __init__(self, **options):
        self.notes = []
        options = {"period": 0.01, "motors": [Motor(joint="slider")], **options}
        super().__init__("cartpole", 0.04, **options)

    def notes_of(self, call):
        self.notes.clear()
        call()
        return list(self.notes)


class Top(traced(Layer, "top.")):
    @property
    def notes(self):
        return self.unwrapped.notes


RESET = ["_setup", "_sample_state", "_initialize_buffers", "_refresh_buffers"]
RESET = [*RESET, "refresh_observation", "has_terminated"]
END = ["_refresh_buffers", "refresh_observation", "has_terminated", "compute_reward"]


def test_reset(backend):
    env = Base(backend=backend)
    for _ in range(2):
        found = env.notes_of(env.reset)
        assert found == [(name, 0) for name in RESET] or found[0][0] == "_setup"
        assert [name for name, _ in found] == RESET  # no command before the first step
        env.step([0.1])


def test_step(backend):
    env = Base(backend=backend, control_period=0.02)
    env.reset()
    ticks = [("compute_command", 0), ("refresh_observation", 2), ("compute_command", 2)]
    for begin in (0, 4):
        found = env.notes_of(lambda: env.step([0.1]))
        wanted = [*ticks, *((name, 4) for name in END)]
        assert found == [(name, begin + now) for name, now in wanted]


@pytest.mark.parametrize(
    ("control", "observe", "ticks"),
    [
        (0.04, 0.01, [("c", 0), ("o", 1), ("o", 2), ("o", 3)]),
        (0.01, 0.04, [("c", 0), ("c", 1), ("c", 2), ("c", 3)]),
        (0.02, 0.01, [("c", 0), ("o", 1), ("o", 2), ("c", 2), ("o", 3)]),
        (None, None, [("c", 0)]),
    ],
)
def test_each_at_its_period(control, observe, ticks):
    env = Base(control_period=control, observe_period=observe)
    env.reset()
    found = env.notes_of(lambda: env.step([0.1]))
    names = {"c": "compute_command", "o": "refresh_observation"}
    assert found[: len(ticks)] == [(names[name], now) for name, now in ticks]
    assert [name for name, _ in found[len(ticks) :]] == END


def test_layers(backend):
    env = Base(backend=backend, control_period=0.02)
    top = Top(env)
    found = [name for name, _ in env.notes_of(top.reset)]
    pairs = [name for hook in RESET[2:] for name in (f"top.{hook}", hook)]
    assert found == ["_setup", "top._setup", "_sample_state", *pairs]
    found = [name for name, _ in env.notes_of(lambda: top.step([0.1]))]
    ticks = ["compute_command", "refresh_observation", "compute_command"]
    assert found == [name for hook in (*ticks, *END) for name in (f"top.{hook}", hook)]


def test_the_state_at_each_call():
    class Watching(RobotEnv):
        seen = ()

        def note(self, name):
            running = bool(self.is_simulation_running)
            self.seen += ((name, running, int(self.num_steps), self.action.tolist()),)

        def _setup(self):
            self.note("setup")

        def _sample_state(self):
            self.note("sample")
            return super()._sample_state()

        def _initialize_buffers(self):
            self.note("initialize")

        def _refresh_buffers(self):
            self.note("refresh")

    env = Watching("cartpole", 0.04, motors=[Motor(joint="slider")], period=0.01)
    env.reset()
    env.step([3.0])
    env.seen = ()
    env.reset()
    env.step([4.0])
    assert env.seen == (
        ("setup", False, 1, [3.0]),
        ("sample", False, 0, [0.0]),
        ("initialize", True, 0, [0.0]),
        ("refresh", True, 0, [0.0]),
        ("refresh", True, 1, [4.0]),
    )


def test_what_is_observed_in_a_command_is_of_the_same_moment(backend):
    class Checking(RobotEnv):
        def compute_command(self, action, command):
            frame = self.simulator.simulation.frame
            times = [float(self.observation["t"]), float(self.measurements["t"])]
            assert times == [frame * 0.01] * 2 and self.stepper_state.iter == frame
            assert np.array_equal(self.robot_state.q, self.simulator.simulation.positions())
            command[:] = action - self.observation["states"]["agent"]["q"][0]

    options = {"motors": [Motor(joint="slider")], "period": 0.01, "control_period": 0.02}
    env = Checking("cartpole", 0.04, backend=backend, **options)
    env.reset()
    for _ in range(3):
        env.step([5.0])


def test_commands_that_are_held_are_computed_once(backend):
    """The same to the last bit as with a command in each period."""

    class Free(RobotEnv):
        holds_command = False

    found = []
    for kind in (RobotEnv, Free):
        options = {"control_period": 0.01, "period": 2e-3, "fixed_base": False}
        env = kind("ant", 0.04, backend=backend, **options)
        env.reset(seed=0)
        env.action_space.seed(0)
        env.step(env.action_space.sample())
        found.append(env.step(env.action_space.sample())[0])
    for kind in ("Encoder", "Imu"):
        assert found[0]["measurements"][kind].tobytes() == found[1]["measurements"][kind].tobytes()


def test_spaces_are_recreated_when_options_change():
    class Weaker(RobotEnv):
        most = 20.0
        made = 0

        def _initialize_action_space(self):
            super()._initialize_action_space()
            self.made += 1

        def _setup(self):
            self.simulator.set_options({"motors": {"slider": {"max_torque": self.most}}})

    env = Weaker("cartpole", 0.04, motors=[Motor(joint="slider")])
    assert env.action_space.high == [30.0]
    env.reset()
    assert env.action_space.high == [20.0] and env.made == 2
    env.reset()
    assert env.made == 2
    env.step([25.0])
    assert env.action == [20.0]


def test_options_in_setup_change_the_periods():
    class Faster(RobotEnv):
        def _setup(self):
            options = {"control_period": self.reset_options.get("control", 0.02)}
            self.simulator.set_options({"stepper": options})

    env = Faster("cartpole", 0.04, period=0.01)
    assert env.control_dt == 0.04
    env.reset()
    assert env.control_dt == env.observe_dt == 0.02
    with pytest.raises(ConfigError, match="multiple of control_period"):
        env.reset(options={"control": 0.03})
    with pytest.raises(EpisodeError):
        env.step(np.zeros(2))


def test_an_exception_stops_the_episode():
    class Failing(RobotEnv):
        def compute_reward(self, terminated, info):
            raise KeyError("missing")

    env = Failing("cartpole", 0.04)
    env.reset()
    with pytest.raises(KeyError):
        env.step(np.zeros(2))
    assert not env.is_simulation_running
    with pytest.raises(EpisodeError, match="stopped"):
        env.step(np.zeros(2))


def test_seeds():
    class Drawing(RobotEnv):
        def _sample_state(self):
            self.drawn = self.np_random.random()
            return super()._sample_state()

    env = Drawing("cartpole", 0.04)
    env.reset(seed=5)
    first, space_draw = env.drawn, env.action_space.sample()
    assert first == np.random.default_rng(5).random() and env.np_random_seed == 5
    env.reset()
    assert env.drawn != first
    env.reset(seed=5)
    assert env.drawn == first and np.array_equal(env.action_space.sample(), space_draw)
    layer = Layer(env)
    layer.reset(seed=5)
    assert env.drawn == first
    env.np_random = np.random.default_rng(1)
    env.reset()
    assert env.np_random_seed == -1 and env.drawn == np.random.default_rng(1).random()


def test_unseeded_environments_differ():
    seeds = set()
    for _ in range(2):
        env = RobotEnv("cartpole", 0.04)
        env.reset()
        seeds.add(env.np_random_seed)
    assert len(seeds) == 2


def test_an_own_action_space_is_filled_at_reset():
    class Offset(RobotEnv):
        def _initialize_action_space(self):
            self.action_space = spaces.Box(1.0, 2.0, (1,), np.float64)

        def compute_command(self, action, command):
            command[:] = action

    env = Offset("cartpole", 0.04, motors=[Motor(joint="slider")])
    env.reset()
    env.step([1.5])
    env.reset()
    assert env.action == [1.0]
