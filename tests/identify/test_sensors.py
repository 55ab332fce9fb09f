"""Logs with forces, contacts and inertial sensors: read, checked, and part of the fit."""

from __future__ import annotations

import dataclasses
import json

import logged_arm as arm
import logged_leg as leg
import numpy as np
import pytest
from logged_flyer import FILE, HIDDEN, KNOWN, hidden, pushed, sensed

from physx_core.cli import main
from physx_core.errors import ComponentNotFoundError, UnknownOptionError
from physx_core.rotations import rotate_back_rows
from physx_dart import DartBackend, PinocchioBackend
from physx_identify import Log, Model, check_log, identify, read_log
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import Base, Imu
from physx_identify.estimation.model import Path
from physx_sim import World

UNKNOWN = ("mass", "damping", "friction")
TABLE = """time,q.shoulder,q.elbow,tau.shoulder,tau.elbow,force.foot_x,force.foot_y,force.foot_z,\
moment.foot_x,moment.foot_y,moment.foot_z,contact.lower,gyroscope_x [deg/s],gyroscope_y [deg/s],\
gyroscope_z [deg/s],accelerometer_x [g],accelerometer_y [g],accelerometer_z [g]"""


@pytest.fixture(scope="module")
def clean():
    return leg.stepping()


def push(time):
    """Return a force and a moment on the foot that come and go."""
    on = np.sin(7 * time) > 0.3
    force = 4 * np.sin(3 * time), 2 * np.cos(5 * time), 6 + 3 * np.sin(11 * time)
    return on * np.array([*force, 0.1 * np.sin(4 * time), 0.2 * np.cos(6 * time), 0.1])


@pytest.fixture(scope="module")
def flight():
    return pushed(hidden(), 300, lift=29.0)


# The model ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", [PinocchioBackend, DartBackend])
def test_the_model_takes_the_steps_of_engines_in_contact(engine):
    positions, torques, wrenches = leg.stepping(engine)
    model, path = Model(leg.hidden()), Path(positions, arm.PERIOD)
    dry = model.dry(path, model.stencil(path, model.numbers), model.numbers)
    by_reading, _ = model.wrenches(path, "lower", wrenches[2:], "world")
    acting = np.einsum("kij,kj->ki", by_reading, wrenches[2:]) - model.friction(path, model.numbers)
    found = model.columns(path, model.numbers[:, None], path.ends)[..., 0]
    found -= model.friction(path, model.numbers) + np.einsum("kij,kj->ki", dry, acting)
    clear = (np.abs(path.ends) > 0.05).all(axis=1)  # dry friction does not stop a joint
    assert wrenches.any(axis=1).sum() > 20
    assert found[clear] == pytest.approx(torques[1:-1][clear], abs=1e-8)


@pytest.mark.parametrize("known", ["pose", "sensor"])
@pytest.mark.parametrize("axes", ["world", "link"])
def test_forces_and_an_inertial_sensor_tell_what_the_pose_does(known, axes):
    robot = KNOWN
    flight, model = pushed(robot, 60, push=push), Model(robot)
    wrench, base, orientations = flight.wrench, flight.q[:, :3], flight.q[:, 3:7]
    pose = Base.of(orientations)
    positions = np.hstack([base, pose.angles, flight.q[:, 7:]])
    path = Path(positions, arm.PERIOD, base=pose)
    if axes == "link" or known == "sensor":
        simulation = PinocchioBackend().build(World([robot], period=arm.PERIOD))
        turns = np.array([simulation.body_poses(["foot"], q)[0, 3:] for q in flight.q])
        wrench = np.hstack([rotate_back_rows(turns, each) for each in np.split(wrench, 2, axis=1)])
        axes = "link"
    if known == "sensor":
        force = np.diff(base, 2, axis=0) / arm.PERIOD**2 - model.gravity
        readings = np.zeros((60, 6))
        readings[2:, :3] = rotate_back_rows(orientations[2:], force)
        readings[1:, 3:] = np.diff(pose.angles, axis=0) / arm.PERIOD
        positions = np.hstack([readings, flight.q[:, 7:]])
        path = Path(positions, arm.PERIOD, base=Imu(np.zeros(3)))
    by_reading, _ = model.wrenches(path, "foot", wrench[2:], axes)
    found = model.columns(path, model.numbers[:, None], path.ends)[..., 0]
    found -= np.einsum("kij,kj->ki", by_reading, wrench[2:])
    near = 1e-9 if axes == "world" else 5e-3  # a step turns the foot to first order
    assert found[1:, 6:] == pytest.approx(flight.torques[2:-1], abs=near)
    assert found[1:, :6] == pytest.approx(0.0, abs=near)


@pytest.mark.parametrize("instant", [False, True])
@pytest.mark.parametrize("sensor", [False, True])
def test_derivatives_are_those_of_the_torques(sensor, instant):
    random, model = np.random.default_rng(0), Model(KNOWN)
    quaternions = random.normal(size=4) + 0.05 * random.normal(size=(7, 4))
    pose = Base.of(quaternions / np.linalg.norm(quaternions, axis=1)[:, None])
    base = Imu(np.array([0.1, -0.2, 0.3])) if sensor else pose
    positions, wrench = random.normal(size=(7, 8)), random.normal(size=(5, 6))
    positions[:, 3:6] = random.normal(size=(7, 3)) if sensor else pose.angles
    positions[:, 6:] *= 0.01
    path = Path(positions, arm.PERIOD, instant, base)

    def torques(positions, axes):
        near = dataclasses.replace(path, positions=positions)
        found = model.columns(near, model.numbers[:, None], path.ends)[..., 0]
        by_reading, _ = model.wrenches(near, "foot", wrench, axes or "world")
        return found, np.einsum("kij,kj->ki", by_reading, wrench)

    stencil = model.stencil(path, model.numbers)
    for number in range(8):
        for place in range(3):
            change = np.zeros_like(positions)
            change[1 + place, number] = 1e-6
            ends = [torques(positions + sign * change, "")[0] for sign in (1, -1)]
            slope = (ends[0] - ends[1])[1] / 2e-6  # of the second sample of the path
            assert slope == pytest.approx(stencil[place, 1, :, number], rel=1e-5, abs=1e-4)
    for axes in ("world", "link") if instant else ("world",):
        slopes = model.wrenches(path, "foot", wrench, axes)[1]
        for number in range(8):
            change = 1e-6 * (np.arange(8) == number)
            ends = [torques(positions + sign * change, axes)[1] for sign in (1, -1)]
            assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slopes[:, :, number], abs=1e-7)


# What is found -----------------------------------------------------------------------------------


@pytest.mark.parametrize("made", [leg.sensed, leg.flagged])
def test_true_values_of_a_leg_in_contact_lie_in_their_intervals(clean, made):
    found = identify(made(clean), leg.KNOWN, UNKNOWN, level=0.999)
    assert found.holds, found
    for name, true in leg.HIDDEN.items():
        assert found[name].low <= true <= found[name].high, found[name]
    assert found["mass lower"].error < 0.02


def test_an_unknown_contact_is_no_noise(clean):
    log = leg.flagged(clean, correlation=0.98, seed=5010)
    true = 0.05 * clean[1].std(axis=0) * np.sqrt(1 - 0.98**2)
    noise = identify(log, leg.KNOWN, UNKNOWN).noise
    assert noise.innovations == pytest.approx(true, rel=0.5)


def test_the_noise_of_forces_is_that_of_the_torques(clean):
    loud, quiet = (
        identify(leg.sensed(clean, force=force, correlation=0.0), leg.KNOWN, UNKNOWN)
        for force in (4.0, 0.0)
    )
    assert loud["mass upper"].error > 2 * quiet["mass upper"].error
    assert loud["mass upper"].low < leg.HIDDEN["mass upper"] < loud["mass upper"].high


def test_an_inertial_sensor_tells_what_the_pose_tells_whatever_its_drift(flight):
    unknown, known = ["mass:lower", "damping", "friction"], KNOWN
    pose = identify(sensed(flight, base=1e-6), known, unknown)
    for drift in (0.0, 0.005):
        log = sensed(flight, inertial=(0.05, 0.005), drift=drift)
        found = identify(log, known, unknown, imu="imu", level=0.999)
        assert found.holds, found
        for name, true in HIDDEN.items():
            assert found[name].low <= true <= found[name].high, found[name]
            assert abs(found[name].value - pose[name].value) < 4 * found[name].error


@pytest.mark.slow
def test_in_flight_the_base_tells_masses_beside_known_forces():
    robot = hidden(friction=False)
    log = sensed(pushed(robot, 120, push=push), base=1e-4, torque=0.2, force=0.01)
    known = dataclasses.replace(robot, mass_factors={})
    found = identify(log, known, "mass:lower", level=0.999, flight=True)["mass lower"]
    assert found.low <= HIDDEN["mass lower"] <= found.high
    assert found.error < 0.02 * found.value


# Files -------------------------------------------------------------------------------------------


def write(path, log, head=TABLE, change=lambda table: table):
    time = arm.PERIOD * np.arange(len(log))
    on = log.contacts["lower"]
    turning, force = np.degrees(log.gyroscope), log.accelerometer / 9.80665
    table = np.column_stack(
        [time, log.positions, log.torques, log.wrenches["foot"], on, turning, force]
    )
    np.savetxt(path, change(table), delimiter=",", header=head, comments="", fmt="%.17g")
    return path


@pytest.fixture(scope="module")
def whole():
    flight = pushed(hidden(), 80, push=push)
    on = np.arange(80) < 10
    log = sensed(flight, base=1e-5, inertial=(0.05, 0.005))
    return dataclasses.replace(log, axes="link", contacts={"lower": on})


def test_a_file_has_forces_contacts_and_an_inertial_sensor(whole, tmp_path):
    write(tmp_path / "log.csv", whole)
    read = read_log(tmp_path / "log.csv", arm.JOINTS, floating=True)
    assert read.left_out == () and read.axes == "link"
    assert read.wrenches["foot"] == pytest.approx(whole.wrenches["foot"])
    assert (read.contacts["lower"] == whole.contacts["lower"]).all()
    assert read.gyroscope == pytest.approx(whole.gyroscope)
    assert read.accelerometer == pytest.approx(whole.accelerometer)
    assert read.base_positions is None
    other = TABLE.replace("force.foot", "left").replace("contact.lower", "touch")
    write(tmp_path / "other.csv", whole, other)
    named = {"force.foot": "left", "contact.lower": "touch"}
    again = read_log(tmp_path / "other.csv", arm.JOINTS, columns=named, axes="world")
    assert again.wrenches["foot"] == pytest.approx(whole.wrenches["foot"])
    assert again.contacts["lower"].sum() == 10 and again.axes == "world"
    assert again.gyroscope is None
    np.savez(
        tmp_path / "log.npz", q=whole.positions, tau=whole.torques, time=np.arange(80) * 0.005,
        **{"wrench.foot": whole.wrenches["foot"], "contact.lower": whole.contacts["lower"]},
    )  # fmt: skip
    arrays = read_log(tmp_path / "log.npz", arm.JOINTS)
    assert arrays.wrenches["foot"] == pytest.approx(whole.wrenches["foot"])
    assert arrays.contacts["lower"].sum() == 10

    def late(table):
        table[40:, 0] += 0.4 * arm.PERIOD
        return table

    uneven = read_log(write(tmp_path / "log.csv", whole, change=late), arm.JOINTS)
    assert set(np.unique(uneven.contacts["lower"])) == {0, 1}


@pytest.mark.slow
def test_the_command_takes_an_inertial_sensor_by_its_frame(tmp_path, capsys):
    log = sensed(pushed(hidden(), 300, lift=29.0), inertial=(0.05, 0.005))
    arrays = {"q": log.positions, "tau": log.torques, "time": arm.PERIOD * np.arange(300)}
    arrays |= {"gyro": log.gyroscope, "accel": log.accelerometer}
    np.savez(tmp_path / "log.npz", **arrays)
    words = ["identify", str(tmp_path / "log.npz"), str(FILE), "--floating", "--imu", "imu"]
    words += ["--level", "0.999", "--free", "mass:lower", "damping", "friction", "--json"]
    assert main(words) == 0
    found = {each["name"]: each for each in json.loads(capsys.readouterr().out)["estimates"]}
    for name, true in HIDDEN.items():
        assert found[name]["low"] <= true <= found[name]["high"]


# Bad logs ----------------------------------------------------------------------------------------

NAMED = [
    (lambda h: h.replace("force.foot_y", "x"), lambda t: t, "fy is missing"),
    (lambda h: h.replace("moment.foot_y", "x"), lambda t: t, "my is missing"),
    (lambda h: h.replace("force.foot_y", "wrench.foot"), lambda t: t, "a wrench has 6"),
    (lambda h: h.replace("contact.lower", "contact.lower [N]"), lambda t: t * 3, "neither 0 nor 1"),
    (lambda h: h.replace("accelerometer_x [g]", "x"), lambda t: t, "accelerometer of the joint"),
    (lambda h: h.replace("accelerometer", "y"), lambda t: t, "no column of accelerometer"),
]


@pytest.mark.parametrize(("head", "change", "message"), NAMED)
def test_a_bad_file_is_named(whole, tmp_path, head, change, message):
    path = write(tmp_path / "log.csv", whole, head(TABLE), change)
    with pytest.raises(IdentificationError, match=message):
        read_log(path, arm.JOINTS, floating=True)


def spoiled(log, **changed):
    return Log(**{**vars(log), **changed})


def scaled(log, factor):
    return spoiled(log, wrenches={link: factor * each for link, each in log.wrenches.items()})


BAD_FORCES = {
    "sign": (lambda x: scaled(x, -1.0), "opposite sign"),
    "kN": (lambda x: scaled(x, 1e-3), "another unit"),
    "mN": (lambda x: scaled(x, 1e3), "another unit"),
    "fixed link": (lambda x: spoiled(x, wrenches={"base": x.wrenches["lower"]}), "no joint moves"),
    "all in contact": (lambda x: spoiled(x, contacts={"lower": np.ones(400)}), "leave 0 samples"),
    "shape": (lambda x: spoiled(x, wrenches={"lower": x.wrenches["lower"][:, :3]}), "fx, fy, fz"),
    "nan": (lambda x: scaled(x, np.nan), "not finite"),
    "half": (lambda x: spoiled(x, contacts={"lower": 0.5 * np.ones(400)}), "force.lower"),
}


@pytest.mark.parametrize("what", BAD_FORCES)
def test_bad_forces_are_named(clean, what):
    spoil, message = BAD_FORCES[what]
    log = leg.sensed(clean)
    check_log(log, Model(leg.KNOWN))
    with pytest.raises(IdentificationError, match=message):
        check_log(spoil(log), Model(leg.KNOWN))


def test_unknown_links_axes_and_uses_are_named(clean):
    log = leg.sensed(clean)
    for kind in ("wrenches", "contacts"):
        given = log.wrenches["lower"] if kind == "wrenches" else np.zeros(400)
        with pytest.raises(ComponentNotFoundError, match="hoof"):
            identify(spoiled(log, **{kind: {"hoof": given}}), leg.KNOWN, "mass")
    with pytest.raises(UnknownOptionError, match="axes"):
        spoiled(log, axes="foot")
    with pytest.raises(IdentificationError, match="Refits on engines know nothing of contacts"):
        identify(log, leg.KNOWN, "mass", engines=["dart"])


BAD_SENSORS = {
    "deg/s": (lambda x: spoiled(x, gyroscope=np.degrees(x.gyroscope)), "are in deg/s"),
    "taken for deg/s": (lambda x: spoiled(x, gyroscope=np.radians(x.gyroscope)), "were taken for"),
    "sign": (lambda x: spoiled(x, gyroscope=-x.gyroscope), "the opposite sign"),
    "g": (lambda x: spoiled(x, accelerometer=x.accelerometer / 9.81), "Is it in g"),
    "gravity": (lambda x: spoiled(x, accelerometer=0.1 * x.accelerometer - 0.0), "Is it in g"),
    "falls": (lambda x: spoiled(x, accelerometer=0.01 * x.accelerometer), "gravity is missing"),
    "half": (lambda x: spoiled(x, gyroscope=None), "a gyroscope and an accelerometer"),
    "world": (lambda x: spoiled(x, wrenches={"foot": np.ones((300, 6))}, axes="world"), "the axes"),
}


@pytest.mark.parametrize("what", BAD_SENSORS)
def test_bad_inertial_sensors_are_named(flight, what):
    spoil, message = BAD_SENSORS[what]
    model = Model(KNOWN)
    log = sensed(flight, inertial=(0.05, 0.005)).with_sensor_at(model.sensor_pose("imu"))
    check_log(log, model)
    with pytest.raises(IdentificationError, match=message):
        check_log(spoil(log), model)


def test_a_sensor_must_be_there(flight):
    log = sensed(flight)
    with pytest.raises(ComponentNotFoundError, match="foot"):
        identify(log, KNOWN, "mass", imu="foot")
    with pytest.raises(IdentificationError, match="no readings of an inertial sensor"):
        identify(spoiled(log, gyroscope=None, accelerometer=None), KNOWN, "mass", imu="imu")
