"""Pipelines from plain data, in code and in files."""

from __future__ import annotations

import json
import pickle

import gymnasium
import numpy as np
import pytest

from physx_core.config import write_toml
from physx_core.errors import (
    ComponentNotFoundError,
    ConfigError,
    ConfigFileError,
    UnknownOptionError,
)
from physx_gym import (
    ComposedEnv,
    ControlledEnv,
    MahonyFilter,
    ObservedEnv,
    PDController,
    RobotEnv,
    build_pipeline,
    load_pipeline,
)

ENVIRONMENT = {
    "cls": "physx_gym:RobotEnv",
    "kwargs": {
        "simulator": {
            "cls": "physx_gym:Simulator.build",
            "kwargs": {"urdf": "ant", "fixed_base": False, "control_period": 0.005},
        },
        "step_dt": 0.02,
    },
}
LAYERS = [
    {"block": {"cls": "MahonyFilter", "kwargs": {"kp": 0.5}}},
    {
        "block": {
            "cls": "PDController",
            "name": "pd",
            "kwargs": {"kp": 30.0, "kd": 0.02, "joint_acceleration_limit": 200.0},
        },
        "wrapper": {"cls": "ControlledEnv", "kwargs": {"augment_observation": True}},
    },
    {
        "wrapper": {
            "cls": "ComposedEnv",
            "kwargs": {
                "reward": {"cls": "Survival"},
                "terminations": [{"cls": "base_height", "kwargs": {"lowest": 0.1}}],
            },
        }
    },
]
LAYERS_OF_BLOCKS = LAYERS[:2]


class Recording(RobotEnv):
    """Remembers its options."""

    def __init__(self, simulator, step_dt, tags=(), **kwargs):
        super().__init__(simulator, step_dt, **kwargs)
        self.tags = tags


RECORDING = {
    "cls": Recording,
    "kwargs": {"simulator": "cartpole", "step_dt": 0.02, "tags": ["a"]},
}


def flat(tree):
    if isinstance(tree, dict):
        return np.concatenate([flat(tree[key]) for key in sorted(tree)])
    return np.ravel(np.asarray(tree, np.float64))


def run(env, steps=6):
    env.action_space.seed(0)
    found = [flat(env.reset(seed=0)[0])]
    for _ in range(steps):
        observed, reward, *_ = env.step(0.1 * env.action_space.sample())
        found.append(np.append(flat(observed), reward))
    return np.concatenate(found)


def in_code():
    from physx_gym import Simulator

    simulator = Simulator.build("ant", fixed_base=False, control_period=0.005)
    env = RobotEnv(simulator, 0.02)
    env = ObservedEnv(env, MahonyFilter("mahony_filter", env, kp=0.5))
    pd = PDController("pd", env, kp=30.0, kd=0.02, joint_acceleration_limit=200.0)
    return ControlledEnv(env, pd, augment_observation=True)


@pytest.mark.slow
def test_toml_json_and_code_are_the_same(tmp_path):
    content = {"env_config": ENVIRONMENT, "layers_config": LAYERS_OF_BLOCKS}
    write_toml(tmp_path / "walker.toml", content)
    (tmp_path / "walker.json").write_text(json.dumps(content), encoding="utf-8")
    expected = run(in_code())
    for made in (
        build_pipeline(ENVIRONMENT, LAYERS_OF_BLOCKS),
        load_pipeline(tmp_path / "walker.toml"),
        load_pipeline(str(tmp_path / "walker.json")),
    ):
        env = made()
        assert [type(each) for each in env.layers] == [RobotEnv, ObservedEnv, ControlledEnv]
        np.testing.assert_array_equal(run(env), expected)
    assert type(build_pipeline(ENVIRONMENT)()) is RobotEnv


def test_rewards_and_terminations_are_described_by_tables():
    env = build_pipeline(ENVIRONMENT, LAYERS)()
    assert isinstance(env, ComposedEnv)
    env.reset(seed=0)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert reward > 0
    assert not terminated
    assert not truncated
    assert any(name.startswith("reward_") for name in info)


class Rewarded(ControlledEnv):
    """A layer with a reward of its own."""

    def compute_reward(self, terminated, info):
        return 7.0


def test_a_custom_layer_and_options_of_the_environment():
    rewarded = {**LAYERS[1], "wrapper": {"cls": Rewarded}}
    env = build_pipeline(ENVIRONMENT, [LAYERS[0], rewarded])(step_dt=0.01)
    assert env.step_dt == 0.01
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[1] == 7.0
    assert build_pipeline(ENVIRONMENT)(step_dt=0.01).step_dt == 0.01


@pytest.mark.parametrize("environment", [ENVIRONMENT, {"cls": "physx/Cartpole-v0"}])
def test_the_engine_is_chosen_when_the_environment_is_made(environment):
    pipeline = build_pipeline(environment)
    assert pipeline(backend="pinocchio").simulator.simulation.engine == "pinocchio"
    assert pipeline().simulator.simulation.engine == "dart"


def test_a_pipeline_is_registered_with_gymnasium(monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    gymnasium.register("Walker-v0", entry_point=build_pipeline(ENVIRONMENT, LAYERS_OF_BLOCKS))
    env = gymnasium.make("Walker-v0", step_dt=0.01)
    assert env.unwrapped.step_dt == 0.01
    env.reset(seed=0)


def test_options_do_not_stick():
    made = build_pipeline(RECORDING)
    first = made(step_dt=0.04, tags=["b"])
    assert (first.step_dt, first.tags) == (0.04, ["b"])
    second = made()
    assert (second.step_dt, second.tags) == (0.02, ["a"])
    second.tags.append("c")
    assert made().tags == ["a"]
    assert RECORDING["kwargs"]["tags"] == ["a"]
    layered = build_pipeline(RECORDING, [{"wrapper": {"cls": "ComposedEnv"}}])
    assert layered(tags=["d"]).tags == ["d"]
    assert layered().tags == ["a"]


def test_tables_may_change_after_the_pipeline_is_built():
    layers = [{"wrapper": {"cls": "ComposedEnv", "kwargs": {}}}]
    made = build_pipeline(RECORDING, layers)
    layers[0]["wrapper"]["cls"] = "nothing"
    made()


@pytest.mark.parametrize("layers", [(), LAYERS_OF_BLOCKS])
def test_pipeline_and_environment_are_pickled(layers):
    made = build_pipeline(ENVIRONMENT, layers)
    again = pickle.loads(pickle.dumps(made))  # noqa: S301 - our own
    assert again == made
    np.testing.assert_array_equal(run(again()), run(made()))
    env = made()
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    other = pickle.loads(pickle.dumps(env))  # noqa: S301 - our own
    action = 0.1 * env.action_space.sample()
    np.testing.assert_array_equal(flat(env.step(action)[0]), flat(other.step(action)[0]))


def test_gymnasium_wrappers_and_classes_in_scripts(tmp_path):
    (tmp_path / "own.py").write_text(
        "from physx_gym import RobotEnv\nclass Own(RobotEnv):\n    mine = True\n",
        encoding="utf-8",
    )
    environment = {**ENVIRONMENT, "cls": f"{tmp_path / 'own.py'}:Own"}
    wrapper = {"wrapper": {"cls": "gymnasium.wrappers:FlattenObservation"}}
    env = build_pipeline(environment, [*LAYERS_OF_BLOCKS, wrapper])()
    assert env.unwrapped.mine
    observed, _ = env.reset(seed=0)
    assert observed.shape == env.observation_space.shape


def test_a_gymnasium_id():
    env = build_pipeline({"cls": "CartPole-v1"})()
    assert type(env).__name__ == "CartPoleEnv"
    assert env.reset(seed=0)[0].shape == (4,)


def altered(path, value):
    """Return the tables with a value set at, or removed from, a path."""
    content = json.loads(json.dumps({"env_config": ENVIRONMENT, "layers_config": LAYERS}))
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return content["env_config"], content["layers_config"]


@pytest.mark.parametrize(
    ("path", "value", "error", "message"),
    [
        (("env_config", "kwarg"), {}, UnknownOptionError, 'no option "kwarg"'),
        (("env_config", "cls"), None, ConfigError, 'env_config has no "cls"'),
        (("env_config", "cls"), "RobotEn", ComponentNotFoundError, 'mean "RobotEnv"'),
        (("env_config", "cls"), "physx_gym:Nothing", ComponentNotFoundError, "Nothing"),
        (("env_config", "cls"), "nowhere:Nothing", ComponentNotFoundError, "nowhere"),
        (("env_config", "cls"), 3, ConfigError, "is not a valid environment"),
        (("env_config", "kwargs"), 3, ConfigError, "env_config.kwargs is 3"),
        (("layers_config", 0, "blok"), {}, UnknownOptionError, 'no option "blok"'),
        (("layers_config", 0, "block"), None, ConfigError, "neither a block nor a wrapper"),
        (("layers_config", 0), 3, ConfigError, "must be a table"),
        (("layers_config",), 3, ConfigError, "must be a list"),
        (("layers_config", 0, "block", "cls"), "Mahony", ComponentNotFoundError, "MahonyFilter"),
        (("layers_config", 0, "block", "cls"), "Targets", ConfigError, "neither an ObserverBlock"),
        (("layers_config", 1, "wrapper", "cls"), "build_pipeline", ConfigError, "is not a class"),
    ],
)
def test_mistakes_in_tables(path, value, error, message):
    with pytest.raises(error, match=message):
        build_pipeline(*altered(path, value))


@pytest.mark.parametrize(
    ("path", "value", "error", "message"),
    [
        (("env_config", "kwargs", "step_dt"), None, ConfigError, "step_dt"),
        (("layers_config", 0, "block", "kwargs", "kpp"), 1, UnknownOptionError, 'mean "kp"'),
        (("layers_config", 1, "block", "kwargs", "kp"), None, ConfigError, "kp"),
        (("layers_config", 1, "wrapper", "kwargs", "no"), 1, UnknownOptionError, '"no"'),
        (
            ("layers_config", 2, "wrapper", "kwargs", "reward", "cls"),
            "Survivl",
            ComponentNotFoundError,
            'mean "Survival"',
        ),
    ],
)
def test_mistakes_in_options(path, value, error, message):
    made = build_pipeline(*altered(path, value))
    with pytest.raises(error, match=message):
        made()


def test_mistakes_in_files(tmp_path):
    with pytest.raises(ConfigFileError, match="There is no"):
        load_pipeline(tmp_path / "none.json")
    with pytest.raises(ConfigFileError, match="There is no"):
        load_pipeline(tmp_path / "none.toml")
    with pytest.raises(ConfigFileError, match=r"must end in \.toml or \.json"):
        load_pipeline(tmp_path / "none.yaml")
    (tmp_path / "bad.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigFileError, match="not valid JSON"):
        load_pipeline(tmp_path / "bad.json")
    (tmp_path / "other.json").write_text('{"env_config": {}, "layer": []}', encoding="utf-8")
    with pytest.raises(UnknownOptionError, match='mean "layers_config"'):
        load_pipeline(tmp_path / "other.json")
    (tmp_path / "empty.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ConfigError, match='has no "env_config"'):
        load_pipeline(tmp_path / "empty.json")
