"""Logs of ROS 2: the topic of all joints is found, or the choice is named."""

from __future__ import annotations

import json

import h5py
import logged_arm as arm
import numpy as np
import pytest
from recorded import states, write_ros2

from physx_core.cli import main
from physx_formats import ExchangeError
from physx_identify import Log, read_log
from physx_identify.errors import IdentificationError

JOINTS = ("elbow", "shoulder")  # as a driver sends them, unlike the robot
TIMES = arm.PERIOD * np.arange(600)


@pytest.fixture(scope="module")
def log():
    return arm.noisy(arm.simulated())


def of(log: Log, names=JOINTS):
    positions, torques = log.positions[:, ::-1], log.torques[:, ::-1]
    speeds = np.gradient(positions, log.period, axis=0)
    return states(names, TIMES, positions, torques, speeds)


def test_a_recording_is_the_log_that_it_was_made_of(log, tmp_path):
    hand = states(["finger"], TIMES[::5], log.positions[::5, :1])
    topics = {"/joint_states": of(log) + hand, "/hand/joint_states": hand}
    path = write_ros2(tmp_path / "run.mcap", topics)
    for topic in (None, "/joint_states", "joint_states/1"):
        read = read_log(path, arm.JOINTS, topic=topic)
        assert read.period == pytest.approx(log.period)
        assert np.array_equal(read.positions, log.positions)
        assert np.array_equal(read.torques, log.torques)
        assert read.velocities is not None
        assert read.left_out == ("log_time",)
    jittery = read_log(path, arm.JOINTS, columns={"time": "log_time"})
    assert np.array_equal(jittery.positions, log.positions)  # 0.2 % of a period: not resampled


def test_a_topic_that_is_not_clear_is_named(log, tmp_path):
    topics = {"/left/joint_states": of(log), "/right/joint_states": of(log)}
    path = write_ros2(tmp_path / "run.mcap", topics)
    both = r"several topics of all joints: left/joint_states \(elbow, shoulder\), right/joint_s"
    for topic, message in (
        (None, both + r".*--topic"),
        ("/joint_states", 'no topic "/joint_states".*It has: left/joint_states, right/'),
        ("/lefd/joint_states", 'Did you mean "left/joint_states"'),
    ):
        with pytest.raises(IdentificationError, match=message):
            read_log(path, arm.JOINTS, topic=topic)
    assert len(read_log(path, arm.JOINTS, topic="/left/joint_states")) == 600
    with pytest.raises(IdentificationError, match=r"no topic of all joints: left/joint_st"):
        read_log(path, ("shoulder", "wrist"))


def test_a_recording_without_the_joints_or_torques_is_named(log, tmp_path):
    path = write_ros2(tmp_path / "run.mcap", {"/joint_states": of(log, ("elbow_1", "shoulder"))})
    with pytest.raises(IdentificationError, match=r'joint "elbow" are missing.*elbow_1'):
        read_log(path, arm.JOINTS)
    free = states(JOINTS, TIMES, log.positions)
    path = write_ros2(tmp_path / "free.mcap", {"/joint_states": free})
    with pytest.raises(IdentificationError, match="no column of torques"):
        read_log(path, arm.JOINTS)
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ExchangeError, match="truncated or damaged"):
        read_log(tmp_path / "cut.mcap", arm.JOINTS)


def test_groups_of_other_files_are_topics(log, tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["arm/q"], file["arm/tau"], file["arm/time"] = log.positions, log.torques, TIMES
        file["hand/q"] = log.positions[:7]
    read = read_log(tmp_path / "run.h5", arm.JOINTS, topic="arm")
    assert np.array_equal(read.torques, log.torques)
    names = {"positions": "arm/q", "torques": "arm/tau", "time": "arm/time"}
    assert np.array_equal(read_log(tmp_path / "run.h5", arm.JOINTS, columns=names).torques,
                          log.torques)  # fmt: skip


@pytest.mark.slow
def test_the_command_reads_a_recording(log, tmp_path, capsys):
    path = write_ros2(tmp_path / "run.mcap", {"/joint_states": of(log)})
    words = ["identify", str(path), "double_pendulum", "--free", "mass:lower", "damping",
             "friction", "--topic", "/joint_states", "--json"]  # fmt: skip
    assert main(words) == 0
    [mass, *_] = json.loads(capsys.readouterr().out)["estimates"]
    assert mass["value"] == pytest.approx(1.2, rel=0.05)
