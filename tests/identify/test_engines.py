"""Refits on engines: the engine of the log finds its values, and what depends on it is named."""

from __future__ import annotations

import dataclasses
import json

import logged_arm as arm
import numpy as np
import pytest

from physx_core.cli import main
from physx_core.errors import ConfigError, PluginNotFoundError
from physx_identify import Log, Model, identify, read_identification, write_identification
from physx_identify.errors import IdentificationError
from physx_identify.estimation.model import Path
from physx_mujoco import MujocoBackend
from physx_report import write_report
from physx_sim import Robot

UNKNOWN = ("mass", "damping", "friction")


class Heavier(MujocoBackend):
    """An engine in which all weighs 5 % more than its world says."""

    def build(self, world, seed=None):
        [robot] = world.robots
        factors = {link: 1.05 * robot.mass_factors.get(link, 1.0) for link in ("upper", "lower")}
        heavy = dataclasses.replace(robot, mass_factors=factors)
        return super().build(dataclasses.replace(world, robots=[heavy]), seed)


@pytest.fixture(scope="module")
def log():
    return arm.noisy(arm.simulated(engine=MujocoBackend), encoder=1e-8, torque=1e-3)


@pytest.fixture(scope="module")
def found(log):
    engines = ["dart", "pinocchio", "mujoco", f"{__file__}:Heavier"]
    return identify(log, arm.KNOWN, UNKNOWN, engines=engines)


def test_the_engine_of_the_log_finds_its_values(found):
    dart, pinocchio, mujoco, _ = found.engines
    apart = {
        engine.engine: {n: abs(engine.values[n] - true) for n, true in arm.HIDDEN.items()}
        for engine in (dart, pinocchio, mujoco)
    }
    for name, each in apart["mujoco"].items():
        assert each < 2.5 * found[name].error
    for name in ("friction elbow", "damping elbow"):  # where a step's friction matters most
        assert apart["mujoco"][name] < 0.7 * apart["dart"][name]
    for name, each in dart.differences.items():  # they take the same steps
        assert each == pytest.approx(pinocchio.differences[name], abs=0.01)


def test_what_an_engine_makes_of_masses_is_found(found):
    *_, mujoco, heavier = found.engines
    for name in ("mass upper", "mass lower"):
        assert heavier.values[name] == pytest.approx(mujoco.values[name] / 1.05, rel=1e-3)
        assert name in heavier.dependent and name in found.dependent
    for name in ("friction elbow", "damping shoulder"):
        assert heavier.differences[name] == pytest.approx(mujoco.differences[name], abs=0.2)


def test_a_refit_is_printed_and_stored(found, tmp_path):
    found = dataclasses.replace(
        found,
        engines=[dataclasses.replace(each, engine=each.engine[-7:]) for each in found.engines],
    )
    assert max(map(len, str(found).splitlines())) <= 80
    assert "Depends on the engine: mass lower, 1.1" in str(found)
    write_identification(tmp_path / "arm.toml", found)
    assert read_identification(tmp_path / "arm.toml").to_plain() == found.to_plain()
    assert "mass lower" in json.loads(found.to_json())["dependent"]


ARM = """
<mujoco><compiler angle="radian"/><worldbody><body name="arm">
  <joint name="swing" axis="0 1 0" range="-0.9 3"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="1"/>
  <body name="hand" pos="0 0 -0.5"><joint name="grip" axis="0 1 0"/>
    <geom type="box" size="0.03 0.05 0.04" mass="0.4"/></body>
</body></worldbody></mujoco>
"""


def test_a_joint_at_its_limit_is_left_out_and_held_joints_stay(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    robot, time = Robot(str(tmp_path / "arm.xml")), arm.PERIOD * np.arange(600)
    model = Model(robot, held=["grip"])
    q = (0.95 * np.sin(3 * time) * np.clip(time, 0, 1))[:, None]
    path = Path(q, arm.PERIOD)
    torques = model.columns(path, model.numbers[:, None], path.ends)[..., 0]
    noise = np.random.default_rng(0).normal(size=(2, 598, 1))
    log = Log(("swing",), arm.PERIOD, q[1:-1] + 1e-5 * noise[0], torques + 0.02 * noise[1])
    found = identify(log, robot, "mass:arm", held=["grip"], engines=["dart"])
    [dart] = found.engines
    assert 0 < dart.stopped < 100
    assert abs(dart.differences["mass arm"]) < 0.1
    assert "limits of joints" in " ".join(str(found).split())


def test_what_no_engine_can_do_is_named_before_the_fit(log):
    for options, error, message in (
        ({"engines": ["bullet"]}, PluginNotFoundError, "bullet"),
        ({"engines": ["dart", "dart"]}, ConfigError, "named twice"),
        ({"engines": ["dart"], "instant": True}, ConfigError, "instant"),
    ):
        with pytest.raises(error, match=message):
            identify(log, arm.KNOWN, "mass", **options)
    with pytest.raises(IdentificationError, match='No engine can be given "stribeck'):
        identify(log, arm.KNOWN, ["mass", "stribeck"], engines=["dart"])


@pytest.mark.slow
def test_the_command_fits_on_engines(log, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    time = log.period * np.arange(len(log))
    np.savez("log.npz", q=log.positions, tau=log.torques, time=time)
    words = ["identify", "log.npz", "double_pendulum", "--engines", "dart", "mujoco"]
    assert main([*words, "--session", "kept"]) == 0
    out = capsys.readouterr().out
    assert "friction elbow" in out.partition("steps of engines")[2]
    assert "steps of engines" in write_report("kept").read_text()
