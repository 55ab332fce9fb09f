"""Logs of robots that float: the base's pose is read, checked, and moves the joints' torques."""

from __future__ import annotations

import dataclasses
import json

import logged_arm as arm
import logged_flyer as flyer
import numpy as np
import pytest

from physx_core.cli import main
from physx_dart import DartBackend, PinocchioBackend
from physx_identify import Log, Model, check_log, identify, read_log
from physx_identify.errors import IdentificationError
from physx_identify.estimation.model import Path
from physx_sim import Robot


@pytest.mark.parametrize("engine", [PinocchioBackend, DartBackend])
def test_the_model_of_a_floating_base_takes_the_steps_of_engines(engine):
    robot = flyer.hidden(friction=False)
    q, torques = flyer.flown(robot, 80, engine)
    log = Log(arm.JOINTS, arm.PERIOD, q[:, 7:], torques,
              base_positions=q[:, :3], base_orientations=q[:, 3:7])  # fmt: skip
    model = Model(robot)
    path = Path(log.coordinates, log.period, base=log.base)
    found = model.columns(path, model.numbers[:, None], path.ends)[..., 0]
    assert np.abs(found[:, :6]).max() < 1e-7  # nothing but gravity acts on the base
    assert found[:, 6:] == pytest.approx(torques[1:-1], abs=1e-7)


@pytest.mark.slow
def test_the_command_finds_what_a_tumbling_robot_hides(tmp_path, capsys):
    log = flyer.noisy(flyer.flown(flyer.hidden(), 600))
    arrays = {"q": log.positions, "tau": log.torques, "time": arm.PERIOD * np.arange(600)}
    arrays |= {"base_position": log.base_positions, "base_quat": log.base_orientations}
    np.savez(tmp_path / "log.npz", **arrays)
    words = [
        "identify",
        str(tmp_path / "log.npz"),
        str(flyer.FILE),
        "--floating",
        "--level",
        "0.999",
    ]
    assert main([*words, "--free", "mass:lower", "damping", "friction", "--json"]) == 0
    found = {each["name"]: each for each in json.loads(capsys.readouterr().out)["estimates"]}
    for name, true in flyer.HIDDEN.items():
        assert found[name]["low"] <= true <= found[name]["high"]
        assert found[name]["error"] < 0.1 * true


@pytest.mark.slow
def test_in_flight_the_base_tells_masses_from_poor_torques():
    robot = flyer.hidden(friction=False)
    log = flyer.noisy(flyer.flown(robot, 120), base=1e-4, torque=0.2)
    known = dataclasses.replace(robot, mass_factors={})
    found = identify(log, known, "mass:lower", level=0.999, flight=True)["mass lower"]
    assert found.low <= flyer.HIDDEN["mass lower"] <= found.high
    assert found.error < 0.02 * found.value


def test_a_pose_is_the_same_from_any_columns(tmp_path):
    log = flyer.noisy(flyer.flown(flyer.hidden(), 80))
    time = arm.PERIOD * np.arange(80)
    whole = np.concatenate([log.base_positions, log.base_orientations, log.positions], axis=1)
    np.savez(tmp_path / "q.npz", q=whole, tau=np.pad(log.torques, ((0, 0), (6, 0))), time=time)
    names = [*(f"base_{each} [mm]" for each in "xyz"), *(f"base_q{each}" for each in "xyzw")]
    head = ["time", *names, "q.shoulder", "q.elbow", "tau.shoulder", "tau.elbow"]
    table = np.column_stack([time, whole * ([1e3] * 3 + [-1] * 4 + [1] * 2), log.torques])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(head), comments="")
    for name, sign in (("q.npz", 1), ("log.csv", -1)):
        read = read_log(tmp_path / name, arm.JOINTS, floating=True)
        assert read.positions == pytest.approx(log.positions)
        assert read.torques == pytest.approx(log.torques)
        assert read.base_positions == pytest.approx(log.base_positions)
        assert read.base_orientations == pytest.approx(sign * log.base_orientations)
        assert (np.sum(read.base_orientations[1:] * read.base_orientations[:-1], axis=1) > 0).all()
    fixed = read_log(tmp_path / "log.csv", arm.JOINTS)
    assert fixed.base is None and "base_qw" in fixed.left_out


def test_a_wrong_pose_is_named(tmp_path):
    robot, known = flyer.KNOWN, Model(flyer.KNOWN)
    log = flyer.noisy(flyer.flown(flyer.hidden(), 80), base=1e-5)
    own = vars(log)
    turned = np.array(log.base_orientations)
    turned[40:] = turned[40:, [1, 0, 3, 2]]
    leapt = log.base_positions + 0.3 * (np.arange(80) == 30)[:, None]
    for changed, message in (
        ({"base_orientations": 1.1 * log.base_orientations}, "length 1.1 in row 0"),
        ({"base_orientations": None}, "a position and an orientation"),
        ({"base_positions": np.nan * leapt}, "base_positions of x are nan"),
        ({"base_orientations": log.base_orientations[:, :3]}, "samples, qx, qy, qz, qw"),
        ({"base_orientations": turned}, "the base turns by"),
        ({"base_positions": leapt}, "the base moves by 1.0"),
        ({"base_positions": None, "base_orientations": None}, "floats, but there is no pose"),
    ):
        with pytest.raises(IdentificationError, match=message):
            check_log(Log(**{**own, **changed}), known)
    check_log(log, known)
    with pytest.raises(IdentificationError, match="but the robot's is fixed"):
        identify(log, Robot(str(flyer.FILE)), "friction")
    np.savez(tmp_path / "q.npz", q=log.positions, tau=log.torques, time=arm.PERIOD * np.arange(80))
    with pytest.raises(IdentificationError, match="no column of base_positions"):
        read_log(tmp_path / "q.npz", arm.JOINTS, floating=True)
    with pytest.raises(IdentificationError, match="Refits on engines need a fixed base"):
        identify(log, robot, "friction", engines=["dart"])
