"""Parameters from logs: true values lie in their intervals, and what cannot be told is named."""

from __future__ import annotations

import dataclasses
import json
import re

import h5py
import logged_arm as arm
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from physx_core import Dataset, Field
from physx_core.cli import main
from physx_core.errors import ComponentNotFoundError, ConfigError, UnknownOptionError
from physx_gym import RandomizedEnv, RobotEnv, Simulator, load_pipeline
from physx_identify import (
    Identified,
    Log,
    Unknown,
    identify,
    propose,
    read_identification,
    read_log,
    store_identification,
    write_identification,
    write_motion,
)
from physx_identify.errors import IdentificationError
from physx_identify.estimation.inertia import (
    body_of,
    cholesky_of,
    from_cholesky,
    is_physical,
    ten_of,
)
from physx_identify.estimation.noise import Noise, Whitener
from physx_identify.excitation import expected_errors
from physx_mujoco import MujocoBackend
from physx_report import write_report
from physx_sim import JointCoupling, JointSettings, Motor, Robot, World

UNKNOWN = ("mass", "damping", "friction")


@pytest.fixture(scope="session")
def clean():
    return arm.simulated()


@pytest.fixture(scope="session")
def found(clean):
    return identify(arm.noisy(clean, correlation=0.9, seed=5), arm.KNOWN, UNKNOWN, level=0.999)


# Intervals ---------------------------------------------------------------------------------------


def test_true_values_lie_in_their_intervals(found):
    assert found.holds, found
    for name, true in arm.HIDDEN.items():
        assert found[name].low <= true <= found[name].high, found[name]
    assert found["mass lower"].error < 0.02
    assert found.noise.encoder == pytest.approx(1e-4, rel=0.2)
    assert found.noise.correlation == pytest.approx([0.9, 0.9], abs=0.08)


def test_errors_agree_with_the_spread_between_blocks(found):
    assert all(0.4 < each.blocks < 2 for each in found.estimates)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.98])
def test_intervals_cover_what_they_say(clean, correlation):
    inside, false, refused = [], 0, 0
    for seed in range(12):
        log = arm.noisy(clean, correlation=correlation, seed=seed)
        found = identify(log, arm.KNOWN, UNKNOWN)
        false += bool(found.lacks)
        if not found.converged:  # two starts end more than a standard error apart: no intervals
            refused += 1
            continue
        inside += [found[n].low <= true <= found[n].high for n, true in arm.HIDDEN.items()]
    assert np.mean(inside) > 0.85
    assert false <= 3 and refused <= 1


@pytest.mark.slow
@pytest.mark.parametrize("engine", arm.ENGINES[1:])
def test_other_engines_logs_are_told_or_called_model_error(engine):
    log = arm.noisy(arm.simulated(engine=engine))
    found = identify(log, arm.KNOWN, UNKNOWN, level=0.999)
    inside = all(found[n].low <= true <= found[n].high for n, true in arm.HIDDEN.items())
    assert inside or not found.holds


def test_biases_gains_and_delays_are_found(clean):
    log = arm.noisy(clean, encoder=1e-5, torque=0.01)
    torques = log.torques + np.array([0.0, 0.3])
    biased = Log(log.joints, log.period, log.positions + np.array([0.02, 0.0]), torques)
    known = arm.hidden()
    found = identify(biased, known, ["bias:elbow", "encoder:shoulder", "friction"])
    assert found["bias elbow"].value == pytest.approx(0.3, abs=0.02)
    assert found["encoder shoulder"].value == pytest.approx(0.02, abs=0.005)
    late = Log(log.joints, log.period, log.positions[:-1], log.torques[:-1])
    late = Log(log.joints, log.period, log.positions[3:], log.torques[:-3] * [0.5, 1.0])
    found = identify(late, known, ["delay", "gain:shoulder"])
    assert found["delay"].value == pytest.approx(3 * log.period, abs=0.1 * log.period)
    assert found["gain shoulder"].value == pytest.approx(2.0, rel=0.03)


def rubbing(engine):
    """Return motion and torques of an arm with strong dry friction."""
    settings = {
        joint: JointSettings(damping=damping, friction=friction)
        for joint, damping, friction in (("shoulder", 0.5, 0.8), ("elbow", 0.2, 0.3))
    }
    robot = Robot("double_pendulum", joints=settings, mass_factors={"lower": 1.2})
    return arm.simulated(robot, 800, engine), settings


@pytest.mark.slow
def test_late_torques_and_strong_dry_friction_are_told():
    clean, settings = rubbing(arm.ENGINES[0])
    for seed in range(3):
        log = arm.noisy(clean, seed=seed)
        late = Log(log.joints, log.period, log.positions[1:], log.torques[:-1])
        found = identify(late, arm.KNOWN, [*UNKNOWN, "delay"], level=0.999)
        assert found.holds, found
        assert found["delay"].low < log.period < found["delay"].high
        for joint, each in settings.items():
            estimate = found[f"friction {joint}"]
            assert estimate.low < each.friction < estimate.high


@pytest.mark.slow
def test_dry_friction_that_fades_as_a_joint_stops_is_left_out():
    clean, settings = rubbing(MujocoBackend)
    for seed in range(3):
        log = arm.noisy(clean, torque=0.005, seed=seed)
        found = identify(log, arm.KNOWN, UNKNOWN, level=0.999)
        assert found.holds, found
        for joint, each in settings.items():
            estimate = found[f"friction {joint}"]
            assert estimate.low < each.friction < estimate.high


def test_dry_friction_that_fades_over_more_steps_is_named_and_can_be_left_out(clean):
    positions, torques = clean
    ends = np.diff(positions, axis=0, append=positions[-1:]) / arm.PERIOD
    fading = np.sign(ends) * np.exp(-np.abs(ends) / 0.1) * (np.gradient(np.abs(ends), axis=0) < 0)
    log = arm.noisy((positions, torques - [0.2, 0.1] * fading), torque=0.005)
    lacks = identify(log, arm.KNOWN, UNKNOWN).lacks
    assert any("fades" in each for each in lacks)
    found = identify(log, arm.KNOWN, UNKNOWN, level=0.999, slowest=0.5)
    assert not any("fades" in each for each in found.lacks)
    for joint in arm.JOINTS:
        estimate = found[f"friction {joint}"]
        assert estimate.low < arm.HIDDEN[f"friction {joint}"] < estimate.high
    with pytest.raises(ConfigError, match="slowest"):
        identify(log, arm.KNOWN, UNKNOWN, slowest=0.0)


def test_an_interval_is_a_profile_where_the_likelihood_is_not_quadratic(clean):
    known = identify(arm.noisy(clean), arm.hidden(), "delay")["delay"]
    assert known.method == "quadratic"
    assert known.low < 0.0 < known.high
    log = arm.noisy(clean, torque=5.0, seed=2)
    found = identify(log, arm.hidden(), "delay")
    assert "by profile" in str(found)
    hardly = found["delay"]
    assert hardly.method == "profile"
    assert abs(np.log((hardly.high - hardly.value) / (hardly.value - hardly.low))) > 0.1
    narrow = identify(log, arm.hidden(), "delay", level=0.5)["delay"]
    assert hardly.low < narrow.low < narrow.high < hardly.high


def test_a_hidden_friction_is_named_and_the_level_refused(clean):
    positions, torques = clean
    speed = np.gradient(positions[:, 0], arm.PERIOD)
    more = np.stack([1.5 * np.sign(speed) * np.exp(-np.abs(speed) / 0.1), 0 * speed], axis=1)
    found = identify(arm.noisy((positions, torques + more)), arm.KNOWN, UNKNOWN)
    assert not found.holds
    assert any("Stribeck" in each and "shoulder" in each for each in found.lacks)
    assert "not 95 % intervals" in str(found)


# What cannot be told -----------------------------------------------------------------------------


@pytest.mark.slow
def test_inseparable_parameters_are_named_with_what_is_told_of_them(clean):
    log = arm.noisy(clean)
    found = identify(log, arm.hidden(), ["inertia:upper", "armature:shoulder"])
    verdicts = {each.name: each.verdict for each in found.estimates}
    assert verdicts["armature shoulder"] == verdicts["Iyy upper"] == "inseparable"
    assert verdicts["Izz upper"] == "inseparable"  # no joint turns about it
    assert found["armature shoulder"].low is None
    together = [each for each in found.combinations if "armature shoulder" in each.factors]
    assert any(len(each.factors) > 1 and each.low is not None for each in together)
    assert all(is_physical(np.array(draw)[:10]) for draw in found.draws)


def test_a_prior_tells_what_the_log_does_not(clean):
    everything = ["mass", "damping", "friction", "gain"]
    found = identify(arm.noisy(clean), arm.hidden(), everything)
    assert found["gain elbow"].verdict == "inseparable"
    known = identify(arm.noisy(clean), arm.hidden(), [*everything[:3], "gain:elbow=1,0.01"])
    assert known["gain elbow"].verdict == "told"


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_any_coordinates_are_a_body(seed):
    random = np.random.default_rng(seed)
    ten = from_cholesky(random.normal(size=10))
    assert is_physical(ten)
    assert from_cholesky(cholesky_of(ten)) == pytest.approx(ten, rel=1e-6, abs=1e-9)
    assert ten_of(*body_of(ten)) == pytest.approx(ten, rel=1e-6, abs=1e-9)


def test_whitening_is_that_of_the_whole_covariance():
    random = np.random.default_rng(0)
    blocks = random.normal(size=(3, 12, 2, 2))
    used = np.ones((12, 2), bool)
    used[5, 1] = False
    noise = Noise(0.3, np.array([0.5, 0.7]), np.array([[0.4, 0.2], [0.6, -0.1]]))
    whitener = Whitener(blocks, used)
    stencil = np.zeros((12, 2, 14, 2))
    for k in range(12):
        stencil[k, :, k : k + 3] = blocks[:, k].transpose(1, 0, 2)
    stencil, kept = stencil.reshape(24, 28), used.ravel()
    covariance = 0.09 * stencil @ stencil.T
    for joint, weights in enumerate(noise.regression):  # it is as old as 500 samples
        answer = lfilter([noise.torque[joint]], [1, *-weights], np.arange(500) == 0)
        lags = [answer[: 500 - lag] @ answer[lag:] for lag in range(12)]
        covariance[joint::2, joint::2] += toeplitz(lags)
    residual = random.normal(size=(12, 2))
    known, left = covariance[np.ix_(kept, kept)], residual.ravel()[kept]
    expected = 0.5 * np.linalg.slogdet(known)[1] + 0.5 * left @ np.linalg.solve(known, left)
    assert whitener.loss(residual, noise) == pytest.approx(expected, rel=1e-3)
    weights = np.zeros(24)
    weights[kept] = np.linalg.solve(known, left)
    corrections = whitener.corrections(residual, noise)
    assert corrections.ravel() == pytest.approx(0.09 * stencil.T @ weights, rel=1e-2, abs=1e-4)


# Logs --------------------------------------------------------------------------------------------


def spoiled(log, **changed):
    return Log(**{**vars(log), **changed})


BAD = {
    "too short": (lambda x: spoiled(x, positions=x.positions[:20], torques=x.torques[:20]),
                  "20 samples"),
    "nan": (lambda x: spoiled(x, torques=np.where(np.arange(600)[:, None] == 7, np.nan, x.torques)),
            "row 7"),
    "period in ms": (lambda x: spoiled(x, period=5.0), "in ms"),
    "joint order": (lambda x: spoiled(x, joints=("elbow", "shoulder")), "in the order"),
    "missing joint": (lambda x: spoiled(x, joints=("shoulder",), positions=x.positions[:, :1],
                                        torques=x.torques[:, :1]), "lacks the joint elbow"),
    "unknown joint": (lambda x: spoiled(x, joints=("shoulder", "wrist")), "elbow"),
    "degrees": (lambda x: spoiled(x, positions=np.degrees(x.positions)), "degrees"),
    "still": (lambda x: spoiled(x, positions=x.positions * [1, 0]), "never change"),
    "frozen encoder": (lambda x: spoiled(x, positions=x.positions[np.arange(600) // 3 * 3]),
                       "repeat"),
    "jump": (lambda x: spoiled(x, positions=x.positions + 2.0 * (np.arange(600) == 300)[:, None]),
             "jump"),
    "velocity units": (lambda x: spoiled(x, velocities=np.degrees(speeds(x))), "degrees"),
    "velocity sign": (lambda x: spoiled(x, velocities=speeds(x) * [1, -1]), "opposite sign"),
    "velocity order": (lambda x: spoiled(x, velocities=speeds(x)[:, ::-1]), "another order"),
    "constant torque": (lambda x: spoiled(x, torques=x.torques * [1, 0]), "never change"),
    "clipped torque": (lambda x: spoiled(x, torques=np.clip(x.torques, -3, 3)), "cut off"),
    "torque sign": (lambda x: spoiled(x, torques=-x.torques), "opposite sign"),
    "torque order": (lambda x: spoiled(x, torques=x.torques[:, ::-1]), "exchanged"),
    "torque units": (lambda x: spoiled(x, torques=1e3 * x.torques), "another unit"),
}  # fmt: skip


def speeds(log):
    return np.gradient(log.positions, log.period, axis=0)


@pytest.mark.parametrize("what", BAD)
def test_a_bad_log_is_named(clean, what):
    spoil, message = BAD[what]
    log = arm.noisy(clean, encoder=1e-5)
    with pytest.raises(IdentificationError, match=re.escape(message)):
        identify(spoil(log), arm.KNOWN, ["mass"])


def test_a_good_log_passes_with_velocities(clean):
    log = arm.noisy(clean, encoder=1e-5)
    found = identify(spoiled(log, velocities=speeds(log)), arm.hidden(), "mass:lower")
    assert found["mass lower"].value == pytest.approx(1.2, rel=0.02)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (lambda t: np.delete(t, slice(50, 60), 0), "gap"),
        (lambda t: t[np.r_[0:50, 30:90]], "does not increase"),
        (lambda t: t[:, :4], "torques of the joint"),
        (lambda t: t[:, :3], "no column of torques"),
    ],
)
def test_a_bad_file_is_named(clean, tmp_path, rows, message):
    with pytest.raises(IdentificationError, match=message):
        read_log(write_csv(tmp_path / "log.csv", arm.noisy(clean), rows), arm.JOINTS)


HEAD = ["time [ms]", "q.shoulder [deg]", "q.elbow [rad]", "tau_shoulder [N mm]", "tau_elbow", "x"]


def write_csv(path, log, change=lambda table: table):
    time = 1e3 * log.period * np.arange(len(log))
    left, right = log.torques.T
    moved = np.degrees(log.positions[:, 0]), log.positions[:, 1]
    table = change(np.column_stack([time, *moved, 1e3 * left, right, 0 * time]))
    head = ",".join(HEAD[: table.shape[1]])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.17g")
    return path


def write_npz(path, log):
    np.savez(path, q=log.positions, tau=log.torques, time=log.period * np.arange(len(log)))
    return path.with_suffix(".npz")


def write_dataset(path, log):
    fields = [Field("q", (2,), unit="rad"), Field("tau", (2,), unit="N m"), Field("time", unit="s")]
    with Dataset.create(path, session="log") as dataset:
        time = log.period * np.arange(len(log))
        dataset.define_fields("training", fields)
        dataset.append("training", {"q": log.positions, "tau": log.torques, "time": time})
    return path


def write_hdf5(path, log):
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["q"], file["tau"] = log.positions, log.torques
        file["time"] = log.period * np.arange(len(log))
    return path.with_suffix(".h5")


@pytest.mark.parametrize("write", [write_csv, write_npz, write_hdf5, write_dataset])
def test_a_log_is_the_same_from_any_format(clean, tmp_path, write):
    log = arm.noisy(clean)
    path = tmp_path / ("log.csv" if write is write_csv else "log")
    read = read_log(write(path, log), arm.JOINTS)
    assert read.period == pytest.approx(log.period)
    assert read.positions == pytest.approx(log.positions)
    assert read.torques == pytest.approx(log.torques)
    assert read.left_out == (("x",) if write is write_csv else ())


def test_an_episode_of_an_environment_is_a_log(tmp_path):
    motors = [Motor(joint=joint) for joint in arm.JOINTS]
    env = RobotEnv(Simulator(World([arm.KNOWN], period=0.005), motors=motors), 0.005)
    env.eval()
    env.reset(seed=0, options={"log_path": str(tmp_path / "episode.h5")})
    for step in range(60):
        env.step(np.sin([0.1 * step, 0.2 * step]))
    env.stop()
    log = read_log(tmp_path / "episode.h5", arm.JOINTS)
    assert log.period == pytest.approx(0.005)
    assert np.ptp(log.torques, axis=0).min() > 0.5


# Into the world ----------------------------------------------------------------------------------


def test_an_identification_survives_its_file(found, tmp_path):
    write_identification(tmp_path / "arm.toml", found)
    assert read_identification(tmp_path / "arm.toml").to_plain() == found.to_plain()
    (tmp_path / "arm.toml").write_text("robot = 1")
    with pytest.raises(IdentificationError, match="not an identification"):
        read_identification(tmp_path / "arm.toml")
    with pytest.raises(IdentificationError, match="There is no identification"):
        read_identification(tmp_path / "none.toml")


def test_a_robot_gets_the_values(found):
    robot = found.applied_to(arm.KNOWN)
    assert robot.mass_factors["lower"] == pytest.approx(found["mass lower"].value)
    assert robot.joints["elbow"].damping == found["damping elbow"].value
    again = found.applied_to(robot)
    assert again.mass_factors == pytest.approx(robot.mass_factors)


def test_episodes_draw_from_the_posterior(found, tmp_path):
    write_identification(tmp_path / "arm.toml", found)
    heavy = Robot("double_pendulum", mass_factors={"lower": 3.0})
    env = RobotEnv(World([heavy], period=0.005), 0.01)
    env = RandomizedEnv(env, randomizations=Identified(tmp_path / "arm.toml"))
    drawn = []
    for seed in range(3):
        env.reset(seed=seed)
        drawn.append(env.drawn["Identified"])
        robot = env.simulator.world.robots[0]
        assert robot.mass_factors["lower"] == pytest.approx(drawn[-1]["mass lower"])  # 1 kg
        assert robot.joints["elbow"].friction == drawn[-1]["friction elbow"]
    assert len({each["mass lower"] for each in drawn}) == 3
    env.reset(seed=0)
    assert env.drawn["Identified"] == drawn[0]


@pytest.mark.parametrize("draws", [[], [[1.0]]])
def test_an_identification_without_draws_is_named(found, draws):
    with pytest.raises(IdentificationError, match="no draws of its 6 parameters"):
        Identified(dataclasses.replace(found, draws=draws))


@pytest.mark.parametrize("where", ["in the file", "in the call", "in code"])
def test_a_file_is_all_that_randomization_needs(found, tmp_path, where):
    write_identification(tmp_path / "arm.toml", found)
    kwargs = 'kwargs = {simulator = "double_pendulum", step_dt = 0.01, period = 0.005}'
    first = 'randomize = "arm.toml"\n' if where == "in the file" else ""
    table = f'{first}[env_config]\ncls = "RobotEnv"\n{kwargs}\n'
    (tmp_path / "swing.toml").write_text(table)
    options = {"randomize": tmp_path / "arm.toml"} if where == "in the call" else {}
    env = load_pipeline(tmp_path / "swing.toml")(**options)
    if where == "in code":
        env = RandomizedEnv(env, randomizations=tmp_path / "arm.toml")
    env.reset(seed=0)
    factors = env.simulator.world.robots[0].mass_factors
    assert factors["lower"] == env.drawn["Identified"]["mass lower"] != 1
    with pytest.raises(IdentificationError, match="There is no identification"):
        load_pipeline(tmp_path / "swing.toml")(randomize="none.toml")


def test_a_proposed_motion_tells_more_than_a_sweep(found, tmp_path):
    motion = propose(found, arm.KNOWN, trials=20)
    time = found.period * np.arange(len(motion.positions))
    sweep = np.sin(2 * np.pi * (0.2 + 0.1 * time) * time)[:, None] * found.farthest
    swept = expected_errors(found, arm.KNOWN, 0.9 * sweep)
    ratio = [motion.errors[name] / swept[name] for name in motion.errors]
    assert np.exp(np.mean(np.log(ratio))) < 1
    assert (np.abs(motion.positions) <= np.array(found.farthest) + 1e-9).all()
    write_motion(tmp_path / "next.csv", motion)
    table = np.genfromtxt(tmp_path / "next.csv", delimiter=",", names=True, deletechars="")
    assert table["q.elbow"] == pytest.approx(motion.positions[:, 1])


@pytest.mark.slow
def test_the_command_line_prints_stores_and_reports(clean, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / "log.csv", arm.noisy(clean))
    words = ["identify", "log.csv", "double_pendulum", "--free", "mass:lower", "friction"]
    assert main([*words, "-o", "arm.toml", "--session", "kept", "--propose", "next.csv"]) == 0
    out = capsys.readouterr().out
    for each in ("mass lower", "columns not used: x", "A motion of"):
        assert each in out
    found = read_identification("arm.toml")
    assert read_identification("kept/identification.toml").to_plain() == found.to_plain()
    assert "What the log says about the robot" in write_report("kept").read_text()
    main([*words, "--json"])
    plain = json.loads(capsys.readouterr().out)
    assert plain["estimates"][0]["unit"] == "kg"
    assert plain["estimates"][0]["method"] == "quadratic"
    assert plain["holds"] is found.holds


def test_wrong_unknowns_are_named(clean):
    log = arm.noisy(clean)
    with pytest.raises(UnknownOptionError):
        Unknown("weight")
    with pytest.raises(ConfigError, match="kind:name=mean,deviation"):
        Unknown.parse("mass:lower=heavy")
    with pytest.raises(ComponentNotFoundError, match="hand"):
        identify(log, arm.KNOWN, "mass:hand")
    with pytest.raises(IdentificationError, match="named twice"):
        identify(log, arm.KNOWN, ["mass", "mass:lower"])
    with pytest.raises(IdentificationError, match="floats"):
        identify(log, Robot("double_pendulum", fixed_base=False), "mass")
    coupled = Robot("double_pendulum", couplings=[JointCoupling({"shoulder": 1, "elbow": 2})])
    with pytest.raises(IdentificationError, match="of coupled joints"):
        identify(log, coupled, "mass")
    with pytest.raises(ConfigError, match="level"):
        identify(log, arm.KNOWN, "mass", level=2.0)


def test_a_session_keeps_the_last_identification(found, tmp_path):
    store_identification(tmp_path / "kept", found)
    store_identification(tmp_path / "kept", found)
    assert read_identification(tmp_path / "kept/identification.toml").source == found.source
