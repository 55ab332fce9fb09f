"""Worlds: what services drive, made from what a user names."""

from __future__ import annotations

import subprocess
import sys
import threading
import uuid

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core import Environment, Field
from physx_core.errors import (
    ActionError,
    ComponentNotFoundError,
    ConfigError,
    EnvironmentFailedError,
    EpisodeError,
    FieldShapeError,
    PluginNotFoundError,
    StateError,
    UnknownOptionError,
    UsageError,
)
from physx_core.toy import Spring
from physx_remote import Worlds, open_worlds

pytestmark = pytest.mark.processes

BOX = spaces.Box(-1, 1, (2,), np.float64)


class Plain(gymnasium.Env):
    observation_space = action_space = BOX
    closed = 0

    def __init__(self, gain=1.0):
        self.gain, self.total = gain, np.zeros(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.total = self.np_random.random(2)
        return self.total.copy(), {"options": options}

    def step(self, action):
        self.total = self.total + self.gain * action
        return self.total.copy(), np.float32(0.5), np.bool_(False), np.bool_(False), {}

    def snapshot(self):
        return self.total.copy()

    def restore(self, state):
        self.total = state.copy()

    def close(self):
        type(self).closed += 1


OWN = """
import gymnasium
class Own(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Discrete(2)
def make(**options):
    return Own()
gymnasium.register("own/Served-v0", entry_point=Own)
"""


@pytest.mark.parametrize("prefix", ["", "gym/"])
@pytest.mark.parametrize("ending", ["", ".py"])
@pytest.mark.parametrize("name", ["own/Served-v0", "Own", "make"])
def test_environments_in_the_working_directory(prefix, ending, name, tmp_path, monkeypatch):
    module = f"served_{uuid.uuid4().hex}"  # modules stay imported
    place = f"{module}{ending}"
    (tmp_path / f"{module}.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each])
    with open_worlds(f"{prefix}{place}:{name}", 2) as worlds:
        assert type(worlds.environments[1].unwrapped).__name__ == "Own"
    with pytest.raises(ComponentNotFoundError, match=f"no_{module}"):
        open_worlds(f"{prefix}no_{place}:{name}")
    gymnasium.registry.pop("own/Served-v0")


def test_ids_of_gymnasium():
    with open_worlds("gym/CartPole-v1", 2) as worlds:
        alone = gymnasium.make("CartPole-v1")
        assert (worlds.num_worlds, worlds.name) == (2, "gym/CartPole-v1")
        assert worlds.observation_space == alone.observation_space
        assert np.array_equal(worlds.reset(1, seed=3)[0], alone.reset(seed=3)[0])
        for _ in range(5):
            observation, reward, *ends, _ = worlds.step(1, 1)
            assert np.array_equal(observation, alone.step(1)[0])
            assert (reward, ends) == (1.0, [False, False])
            assert [type(value) for value in (reward, *ends)] == [float, bool, bool]


@pytest.mark.parametrize(
    ("reference", "error", "said"),
    [
        ("gym/CartPol-v1", ComponentNotFoundError, 'Did you mean "CartPole-v1"'),
        ("nowhere/Nothing-v0", ComponentNotFoundError, "Gymnasium .*package:id"),
        ("nowhere:Nothing-v0", ComponentNotFoundError, "module path has no .*nowhere"),
        ("toy/sprin", ComponentNotFoundError, 'Did you mean "spring"'),
        ("nowhere/spring", PluginNotFoundError, "nowhere"),
        ("physx_core.toy:Linear", ConfigError, "not an environment|not take|not a Gymnasium"),
        ("physx_remote.serving.worlds:open_worlds", ConfigError, "does not take"),
    ],
)
def test_unresolvable_references(reference, error, said):
    with pytest.raises((error, UsageError), match=said):
        open_worlds(reference)


@pytest.mark.parametrize("name", ["physx/Cartpole-v0", "physx_gym:physx/Cartpole-v0"])
def test_ids_of_another_package(name):
    pytest.importorskip("physx_gym", reason="it registers the id")
    code = f"from physx_remote import open_worlds; print(open_worlds({name!r}).name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == name, done.stderr


def test_arguments_reach_each_environment():
    worlds = open_worlds(Plain, 2, {"gain": 3.0})
    for world in range(2):
        start, _ = worlds.reset(world, seed=world)
        assert np.array_equal(worlds.step(world, np.ones(2))[0], start + 3)
    with pytest.raises(ConfigError, match="gian"):
        open_worlds(Plain, 1, {"gian": 3.0})
    with pytest.raises(ConfigError, match="gian"):
        open_worlds("gym/CartPole-v1", 1, {"gian": 3.0})
    with pytest.raises(UnknownOptionError, match='Did you mean "mass"'):
        open_worlds("toy/spring", 1, {"mas": 3.0})


def test_an_error_within_a_constructor_is_its_own():
    def make():
        return {}["within"] + Plain()

    def confused():
        return len(3)

    with pytest.raises(KeyError, match="within"):
        open_worlds(make)
    with pytest.raises(TypeError, match="len"):
        open_worlds(confused)


def test_a_function_must_return_an_environment():
    with pytest.raises(UsageError, match="not a Gymnasium environment"):
        open_worlds(lambda: 3)
    with pytest.raises(ConfigError, match="at least 1"):
        open_worlds(Plain, 0)
    with pytest.raises(UsageError, match="one world"):
        open_worlds(Plain(), 2)
    with pytest.raises(UsageError, match="at least one"):
        Worlds([])


def test_worlds_with_different_spaces_are_closed_again():
    made = []

    def make():
        made.append(Plain())
        made[-1].action_space = spaces.Discrete(1 + len(made))
        return made[-1]

    closed = Plain.closed
    with pytest.raises(UsageError, match=r"World 1 has the action_space Discrete\(3\)"):
        open_worlds(make, 2)
    assert Plain.closed - closed == 2


def test_snapshots_go_through_wrappers_and_count_their_steps():
    worlds = Worlds([gymnasium.wrappers.TimeLimit(Plain(), 3)])
    assert worlds.has_snapshots
    worlds.reset(0, seed=1)
    worlds.step(0, np.ones(2))
    state = worlds.snapshot(0)
    first = [worlds.step(0, np.ones(2)) for _ in range(2)]
    worlds.restore(0, state)
    second = [worlds.step(0, np.ones(2)) for _ in range(2)]
    np.testing.assert_equal(first, second)
    assert first[-1][3], "truncated by the limit, both times"
    with pytest.raises(UsageError, match="was not returned by snapshot"):
        worlds.restore(0, {"environment": 3})


class Holds(Plain):
    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()

    snapshot = None


def test_worlds_without_snapshots_name_what_holds_them():
    worlds = Worlds([gymnasium.wrappers.TimeLimit(Holds(), 3)])
    assert not worlds.has_snapshots
    with pytest.raises(UsageError, match=r"no snapshots: _World\S*env.lock \(_thread.lock"):
        worlds.snapshot(0)


@pytest.mark.parametrize("name", ["gym/CartPole-v1", "physx/Cartpole-v0"])
def test_any_world_goes_on_in_another(name):
    worlds = open_worlds(name, 2)
    for world in (0, 1):
        worlds.reset(world, seed=4 + world)
    worlds.environments[0].action_space.seed(3)
    action = worlds.environments[0].action_space.sample()
    worlds.step(0, action)
    state = worlds.snapshot(0)
    first = [worlds.step(0, action) for _ in range(3)]
    for world in (1, 0):
        worlds.restore(world, state)
        np.testing.assert_equal([worlds.step(world, action) for _ in range(3)], first)
    worlds.close()


def test_a_world_of_physx_goes_back_after_a_reset():
    worlds = open_worlds("toy/spring", 2)
    for world in (0, 1):
        worlds.reset(world, seed=4)
    worlds.step(0, {})
    state = worlds.snapshot(0)
    first = [worlds.step(0, {}), worlds.reset(0), worlds.step(0, {})]
    worlds.restore(0, state)
    np.testing.assert_equal([worlds.step(0, {}), worlds.reset(0), worlds.step(0, {})], first)
    with pytest.raises(StateError, match="attributes differ: .*instance_id"):
        worlds.restore(1, state)
    worlds.close()


# Environments of physx ------------------------------------------------------------------------


def test_an_environment_of_physx_is_a_gymnasium_environment():
    with open_worlds("toy/spring", 2, {"mass": 2.0}) as worlds:
        assert set(worlds.observation_space.spaces) == {"state", "force", "next_state"}
        assert worlds.action_space == spaces.Dict({})
        first, info = worlds.reset(0, seed=5)
        assert worlds.observation_space.contains(first)
        assert (int(info["env_id"]), int(info["step"])) == (1, 0)
        second, reward, terminated, truncated, info = worlds.step(0, {})
        assert np.array_equal(second["state"], first["next_state"])
        assert (reward, terminated, truncated, int(info["step"])) == (0.0, False, False, 1)
        assert np.array_equal(worlds.reset(0, seed=5)[0]["state"], first["state"])
        assert not np.array_equal(worlds.reset(0)[0]["state"], first["state"])
        assert not np.array_equal(worlds.reset(1, seed=5)[0]["state"], first["state"])


def test_the_samples_are_those_of_the_environment_itself():
    environment = Spring(seed=[5])
    environment.create()
    with open_worlds("toy/spring") as worlds:
        assert np.array_equal(worlds.reset(0, seed=5)[0]["state"], environment.state)


class Controlled(Environment):
    """Asks for what it is to do within its step, and is told before it too."""

    def __init__(self, *, length=4, bad="", **kwargs):
        super().__init__(**kwargs)
        self.length, self.bad = length, bad
        self.applied = None

    def create(self):
        self.position = 0.0

    def init_database(self):
        self.define_training_fields(
            [
                ("position", np.ndarray),
                Field("force", (1,), "float32"),
                ("reward", float),
                ("terminated", bool),
                Field("count", (), "int32"),
                Field("lit", (2,), "bool"),
            ]
        )
        self.define_additional_fields(("note", np.ndarray))

    def apply_prediction(self, prediction):
        self.applied = prediction["force"]

    def step(self):
        force = self.get_prediction(position=self.position)["force"]
        assert np.array_equal(force, [0.0] if self.applied is None else self.applied)
        self.position += float(force[0])
        if self.step_index and self.step_index % 3 == 0:
            self.new_episode()
        shape = 3 if self.bad == "shape" and self.step_index else 2
        if self.bad == "error" and self.step_index:
            raise ArithmeticError("over")
        self.set_training_data(
            position=np.full(shape, self.position),
            force=force,
            reward=-abs(self.position),
            terminated=self.position > self.length,
            count=self.step_index,
            lit=[True, False],
        )
        self.set_additional_data(note=[self.step_index])


def controlled(**arguments):
    return open_worlds(Controlled, 1, {"action_fields": ["force"], **arguments})


def test_the_action_is_the_prediction():
    worlds = controlled()
    space = worlds.observation_space
    assert set(space.spaces) == {"position", "force", "count", "lit"}
    assert worlds.action_space == spaces.Dict({"force": spaces.Box(-np.inf, np.inf, (1,))})
    first, _ = worlds.reset(0, seed=0)
    assert space.contains(first)
    moved = worlds.step(0, {"force": [1.5]})
    assert moved[0]["position"].tolist() == [1.5, 1.5]
    assert moved[1:4] == (-1.5, False, False)
    assert moved[4]["note"].tolist() == [1]
    assert worlds.step(0, {"force": np.array([3.0])})[2], "terminated"
    assert worlds.step(0, {"force": np.array([0.0])})[3], "truncated by the new trajectory"


@pytest.mark.parametrize("force", [[1.0, 2.0], [np.nan], ["x"], [[1.0]]])
def test_actions_are_checked(force):
    worlds = controlled()
    with pytest.raises(EpisodeError, match=r"reset\(\)"):
        worlds.step(0, {"force": [1.0]})
    worlds.reset(0)
    with pytest.raises(ActionError, match="force"):
        worlds.step(0, {"force": force})
    with pytest.raises(ActionError, match="has the fields force"):
        worlds.step(0, {"torque": [1.0]})


def test_errors_of_the_environment_pass_through():
    worlds = controlled(bad="error")
    worlds.reset(0)
    with pytest.raises(EnvironmentFailedError, match="over"):
        worlds.step(0, {"force": [0.0]})
    worlds = controlled(bad="shape")
    worlds.reset(0)
    with pytest.raises(FieldShapeError, match="position"):
        worlds.step(0, {"force": [0.0]})
    with pytest.raises(UsageError, match="options"):
        worlds.reset(0, options={"a": 1})
    with pytest.raises(ConfigError, match='Did you mean "force"'):
        controlled(action_fields=["forc"])


def test_without_action_fields_there_is_no_prediction():
    with pytest.raises(UsageError, match="action_fields"):
        open_worlds(Controlled)
