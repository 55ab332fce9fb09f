"""How far engines agree: planted differences are named, equal engines part in nothing."""

from __future__ import annotations

import json
import re

import numpy as np
import planted
import pytest
from planted import Stagger, late_on, plants

from physx_agree import Agreement, agree, read_agreement, store_agreement
from physx_agree.scores import Score, interval_of, rankings, student
from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.cli import main
from physx_core.errors import ConfigError, SessionError
from physx_report import write_report
from physx_sim import Ground, Robot, World

TASK = "physx_gym:physx/Cartpole-v0"
pytestmark = pytest.mark.slow


def parting_of(task, *engines, **options):
    found = agree(task, engines, seeds=[0], **{"steps": 120, **options})
    [parting] = found.partings
    return parting


# Engines that part -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "one", "other"),
    [
        ("shape", "dart", "dart"),
        ("restitution", "dart", "dart"),
        ("position limit", "dart", "pinocchio"),
        ("torque limit", "pinocchio", "mujoco"),
        ("joint friction", "mujoco", "dart"),
        ("contact friction", "pinocchio", "mujoco"),
    ],
)
def test_a_planted_difference_is_named(name, one, other, tmp_path):
    plant = plants(tmp_path)[name]
    parting = parting_of(Stagger, one, planted.planted(other, plant.change))
    assert plant.is_named_in(parting.causes)
    assert parting.unexplained < 0.1
    assert all(cause.confirmed for cause in parting.causes)


def test_several_planted_differences_are_told_apart(tmp_path):
    known = plants(tmp_path)
    hidden = [known[name] for name in ("mass", "gravity", "damping")]

    def change(world):
        for plant in hidden:
            world = plant.change(world)
        return world

    parting = parting_of(Stagger, "pinocchio", planted.planted("pinocchio", change))
    assert all(plant.is_named_in(parting.causes) for plant in hidden)
    assert len(parting.causes) == len(hidden)
    assert sum(cause.share for cause in parting.causes) == pytest.approx(1.0, abs=1e-3)
    assert parting.unexplained < 1e-3


@pytest.mark.parametrize("engine", ["dart", "pinocchio", "mujoco"])
def test_an_engine_agrees_with_itself(engine):
    parting = parting_of(Stagger, engine, planted.planted(engine, lambda world: world))
    assert (parting.parted, parting.first, parting.through) == (0, None, "")
    assert (parting.causes, parting.unconfirmed, parting.unexplained) == ((), (), 0.0)


def test_what_lies_above_the_engine_is_read_and_given_to_the_other():
    engine = planted.planted("pinocchio", lambda world: world)
    [cause] = [
        each
        for each in parting_of(late_on(engine), "dart", engine).causes
        if each.kind == "above the engine"
    ]
    assert cause.text == "Late.delay: 0 | 1"
    assert "commands to the joints are equal" in cause.confirmed


def test_descriptions_that_differ_are_named_as_such():
    def make(backend):
        friction = 0.8 if backend == "pinocchio" else 0.4
        robots = [Robot("ant", fixed_base=False)]
        world = World(robots, planted.PERIOD, ground=Ground(friction=friction))
        return Stagger(backend=backend, world=world)

    other = planted.planted("pinocchio", lambda world: world)
    [cause] = parting_of(make, "pinocchio", other).causes
    assert cause.kind == "description"
    assert "world.ground.friction: 0.8 | 0.4" in cause.text


def test_a_chaotic_task_without_contacts_parts_by_rounding_only(tmp_path):
    world = World([Robot(planted.chain(tmp_path / "chain.urdf"))], planted.PERIOD)

    def make(backend):
        return planted.Chain(backend=backend, world=world)

    parting = parting_of(make, "dart", "mujoco", steps=2000)
    assert (parting.parted, parting.unexplained) == (0, 0.0)
    [cause] = parting.causes
    assert cause.kind == "sensitivity"
    assert 0 < parting.away < 8 and parting.growth > 1


# Metrics and policies ----------------------------------------------------------------------------


def test_policies_keep_their_ranking():
    def steady(env):
        return lambda observation: np.zeros(env.action_space.shape)

    def wild(env):
        return lambda observation: env.action_space.high

    policies = {"wild": wild, "steady": steady}
    found = agree(
        planted.Rewarded, ["dart", "mujoco"], policies, seeds=range(4), steps=20, metric="effort"
    )
    assert [(each.policy, each.engine) for each in found.scores] == [
        ("wild", "dart"), ("wild", "mujoco"), ("steady", "dart"), ("steady", "mujoco"),
    ]  # fmt: skip
    [ranking] = found.rankings
    assert ranking.policies == ("wild", "steady")
    assert ranking.verdict == "survives"


@pytest.mark.parametrize(
    ("other", "verdict"),
    [((1.0, 1.1, 0.9), "survives"), ((-1.0, -1.1, -0.9), "reversed"), ((1.0, -1.0, 0.3), "open")],
)
def test_a_ranking_survives_only_if_no_interval_doubts_it(other, verdict):
    zero = (0.0, 0.0, 0.0)
    scores = [
        Score("a", "dart", (1.0, 1.2, 0.8)),
        Score("b", "dart", zero),
        Score("a", "mujoco", other),
        Score("b", "mujoco", zero),
    ]
    [ranking] = rankings(scores)
    assert ranking.verdict == verdict


def test_intervals_are_those_of_student():
    from scipy import stats

    for freedom in range(2, 40):
        assert student(0.975, freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=0.02)
    values = [1.0, 2.0, 4.0, 3.0]
    low, high = interval_of(values)
    error = stats.sem(values)
    assert (low, high) == pytest.approx(stats.t.interval(0.95, 3, np.mean(values), error), rel=0.02)
    assert interval_of([1.0, 2.0]) is None


# Mistakes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"engines": ["dart"]}, "two engines"),
        ({"seeds": []}, "no seed"),
        ({"steps": 0}, "at least 1"),
        ({"metric": "speed"}, 'no "speed". Metrics of this task: return, length'),
        ({"task": "CartPole-v1"}, "does not take these arguments"),
    ],
)
def test_mistakes_are_explained(options, words):
    given = {"task": Stagger, "engines": ["dart", "dart"], "seeds": [0], **options}
    with pytest.raises(ConfigError, match=re.escape(words)):
        agree(given.pop("task"), given.pop("engines"), **given)


# The command, and what it keeps ------------------------------------------------------------------


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        assert main(["agree", "physx_gym:physx/Cartpole-v0", "--episodes", "3", *words]) in (
            None,
            0,
        )
        return capsys.readouterr().out

    return run


def test_the_command_prints_80_columns_and_keeps_its_result(command, tmp_path):
    text = command("--engines", "dart", "pinocchio", "--output", "kept")
    assert store_agreement("again", read_agreement("kept")) is None
    assert read_agreement("again") == read_agreement("kept")
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert "0 of" in text and "physics steps part them" in text
    kept = read_agreement("kept")
    assert isinstance(kept, Agreement)
    assert lines[: len(str(kept).splitlines())] == str(kept).splitlines()
    page = write_report("kept").read_text()
    assert "How far engines agree" in page and "pinocchio" in page


def test_the_command_prints_json(command):
    found = json.loads(command("--engines", "dart", "mujoco", "--json"))
    assert found["engines"] == ["dart", "mujoco"]
    assert [each["engine"] for each in found["scores"]] == ["dart", "mujoco"]


@pytest.mark.processes
def test_the_command_ranks_trained_policies(command, tmp_path):
    options = {"session_dir": str(tmp_path), "quiet": True}
    task = EnvironmentConfig(
        f"gym/{TASK.partition(':')[2]}", {"continuous": True}, as_tcp_ip_client=False, seed=0
    )
    DataGeneration(task, session_name="data", batch_nb=1, batch_size=50, **options).execute()
    fields = {"net_fields": "observation", "opt_fields": "action"}
    for name in ("one", "two"):
        network = NetworkConfig("toy/linear", network_kwargs=fields)
        data = DatasetConfig(str(tmp_path / "data"))
        Training(network, data, session_name=name, epoch_nb=1, batch_size=50, **options).execute()
    policies = ("--policy", "one", "--policy", "two", "--env-kwargs", "continuous=True")
    found = json.loads(command("--engines", "dart", "pinocchio", "--json", *policies))
    assert [each["policy"] for each in found["scores"]] == ["one", "one", "two", "two"]
    [ranking] = found["rankings"]
    assert sorted(ranking["policies"]) == ["one", "two"]
    assert ranking["margins"]["dart"] == ranking["margins"]["pinocchio"]


def test_a_damaged_result_says_so(command, tmp_path):
    command("--engines", "dart", "dart", "--output", "kept")
    place = tmp_path / "kept" / "agreement.json"
    assert read_agreement(tmp_path) is None
    place.write_text(place.read_text().replace('"partings"', '"parting"'))
    with pytest.raises(SessionError, match="damaged"):
        read_agreement("kept")
