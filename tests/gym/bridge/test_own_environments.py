"""Environments of the user's own, named on the command line."""

import json
import sys
import uuid

import gymnasium
import pytest

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.cli import main
from physx_core.errors import ConfigError, PhysxError
from physx_gym import ParallelVectorEnv
from physx_gym.bridge.make_env import make_env

pytestmark = pytest.mark.processes

OWN = """
import gymnasium, numpy as np

class Wait(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 9, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)
    def __init__(self, steps=3):
        self.steps = steps
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = self.steps
        return np.full(1, self.left, np.float64), {}
    def step(self, action):
        self.left -= 1
        return np.full(1, self.left, np.float64), 1.0, False, self.left == 0, {}

def make(steps=2):
    return gymnasium.wrappers.TimeLimit(Wait(9), steps)

def fail(steps=2):
    return len(steps)

gymnasium.register("own/NAME-v0", entry_point=Wait)
gymnasium.register("NAME", entry_point=make)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The name of a module in the working directory, which Python does not look for there."""
    name = f"own_{uuid.uuid4().hex}"  # modules stay imported, and folders have former names again
    (tmp_path / f"{name}.py").write_text(OWN.replace("NAME", name))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each])
    yield name
    for id in (f"own/{name}-v0", name):
        gymnasium.registry.pop(id, None)


FORMS = (
    *("{0}:own/{0}-v0", "{0}.py:own/{0}-v0", "{0}:{0}", "{0}:Wait", "{0}.py:Wait"),
    *("{0}:make", "{0}.py:make"),
)


def length(form):
    return 2 if "make" in form or form == "{0}:{0}" else 3


@pytest.mark.parametrize("form", [*FORMS, *(f"gym/{form}" for form in FORMS)])
def test_every_form_names_the_environment(own, form):
    env = make_env(form.format(own), {})
    env.reset()
    ends = [
        env.step(env.action_space.sample())[3] for _ in range(length(form.removeprefix("gym/")))
    ]
    assert ends == [False] * (len(ends) - 1) + [True]


@pytest.mark.parametrize("form", ["{0}:own/{0}-v0", "{0}.py:make", "gym/{0}:own/{0}-v0"])
def test_commands_take_them(own, form, tmp_path, capfd):
    named = form.format(own)
    adapted = named if named.startswith("gym/") else f"gym/{named}"
    words = ["--batch-nb", "2", "--batch-size", "6", "--environment.num-clients", "2"]
    assert main(["generate", adapted, *words]) == 0
    with Dataset.open(tmp_path / "sessions/data_generation") as dataset:
        assert dataset["training"]["truncated"][:].sum() >= 2
    network = NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": "observation", "opt_fields": "action"}
    )
    data = DatasetConfig("sessions/data_generation")
    Training(network, data, epoch_nb=1, batch_size=6, quiet=True).execute()
    capfd.readouterr()
    assert main(["evaluate", "sessions/training", "--env", named, "--episodes", "1", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["episodes"][0]["length"] == length(form.removeprefix("gym/"))


@pytest.mark.parametrize("form", ["{0}:own/{0}-v0", "{0}.py:make", "gym/{0}:Wait"])
def test_they_are_stepped_in_processes(own, form):
    with ParallelVectorEnv(form.format(own), 2, num_processes=1) as many:
        many.reset(seed=0)
        assert many.step(many.action_space.sample())[1].tolist() == [1.0, 1.0]


def test_mistakes_are_named_without_a_traceback(own, capfd):
    known = {
        f"{own}x:own/{own}-v0": "has no environment",
        f"{own}:own/other-v0": "is not registered with Gymnasium",
        f"{own}:mak": 'Did you mean "make"',
        f"{own}:Wayt": 'Did you mean "Wait"',
        f"{own}:OWN": "has no environment",
        f"{own}:gymnasium": "is not a physx environment",
        "HalfCheetah-v2": "Gymnasium cannot create HalfCheetah-v2",
    }
    for named, told in known.items():
        with pytest.raises(PhysxError, match=told):
            make_env(named, {})
    for named in (f"{own}:make", f"{own}:own/{own}-v0", f"{own}:Wait"):
        with pytest.raises(ConfigError, match="does not take these arguments.*stepps"):
            make_env(named, {"stepps": 3})
    with pytest.raises(TypeError, match=r"no len"):
        make_env(f"{own}:fail", {})
    words = ["--batch-nb", "1", "--batch-size", "1"]
    assert main(["generate", f"{own}:make", *words]) == 1
    assert f'give "gym/{own}:make"' in capfd.readouterr().err
    assert main(["generate", f"{own}:Wait", *words]) == 1
    assert f'give "gym/{own}:Wait"' in capfd.readouterr().err
