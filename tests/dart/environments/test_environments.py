"""The arm and the double pendulum, driven as a pipeline drives them."""

from __future__ import annotations

import importlib.metadata

import numpy as np
import pytest

from physx_core import Factory, plugins
from physx_core.errors import ConfigError, UnknownOptionError
from physx_dart.environments.arm import DartArm, PinocchioArm
from physx_dart.environments.double_pendulum import DartDoublePendulum, PinocchioDoublePendulum
from physx_dart.environments.trajectories import SmoothTrajectory
from physx_sim.errors import ModelError

ARMS = [DartArm, PinocchioArm]
PENDULUMS = [DartDoublePendulum, PinocchioDoublePendulum]


def rms(samples):
    return np.sqrt(np.mean([sample["tracking_error"] ** 2 for sample in samples]))


def test_environments_are_found_by_name():
    assert plugins.resolve("environment", "dart/arm") is DartArm
    assert plugins.resolve("environment", "pinocchio/arm") is PinocchioArm
    assert plugins.resolve("environment", "dart/double-pendulum") is DartDoublePendulum
    assert plugins.resolve("environment", "pinocchio/double-pendulum") is PinocchioDoublePendulum


@pytest.mark.parametrize("arm", ARMS)
def test_samples_satisfy_the_inverse_dynamics(arm, drive):
    environment = drive.make(arm)
    layout = environment.simulation.layout
    for sample in drive(environment, 120):
        q, v, a = np.split(sample["state"], 3)
        tau = sample["torque"]
        again = environment.simulation.inverse_dynamics(q, v, a)
        np.testing.assert_allclose(again, tau, atol=1e-9)
        assert ((q > layout.lower) & (q < layout.upper)).all()
        assert (np.abs(v) < layout.max_velocity).all()
        assert (np.abs(tau) < layout.max_torque).all()


@pytest.mark.parametrize("pendulum", PENDULUMS)
def test_samples_of_the_pendulum_satisfy_the_forward_dynamics(pendulum, drive):
    environment = drive.make(pendulum)
    samples = drive(environment, 50)
    for sample in samples:
        q, v = np.split(sample["state"], 2)
        a = environment.simulation.forward_dynamics(q, v, sample["torque"])
        np.testing.assert_array_equal(sample["acceleration"], a)
    assert np.ptp([sample["torque"] for sample in samples]) > 0.1
    free = drive(pendulum, 5, torque_amplitude=0.0)
    assert all((sample["torque"] == 0).all() for sample in free)


@pytest.mark.parametrize("environment", [DartArm, DartDoublePendulum])
def test_seed_and_instance_determine_the_samples(environment, drive):
    def states(**options):
        return np.array([sample["state"] for sample in drive(environment, 8, **options)])

    first = states(seed=5, episode_steps=3)
    np.testing.assert_array_equal(states(seed=5, episode_steps=3), first)
    assert np.abs(states(seed=6, episode_steps=3) - first).max() > 0.1
    assert np.abs(states(seed=5, episode_steps=3, instance_id=2) - first).max() > 0.1


@pytest.mark.parametrize("environment", [DartArm, PinocchioDoublePendulum])
def test_each_motion_is_a_separate_trajectory(environment, drive):
    made = drive.make(environment, episode_steps=3)
    numbers = []
    for _ in range(8):
        drive(made, 1)
        numbers.append(made.sample_episode)
    assert numbers == [0, 0, 0, 1, 1, 1, 2, 2]


def test_fields_are_those_of_the_samples(drive):
    for task, names in (
        ("excite", {"state", "torque"}),
        ("track", {"state", "torque", "tracking_error", "reference", "position"}),
    ):
        environment = drive.make(DartArm, task=task)
        (sample,) = drive(environment, 1)
        assert sample.keys() == names
        for field in environment.fields:
            assert np.shape(sample[field.name]) == field.shape
        roles = {field.name: field.role for field in environment.fields}
        assert {name for name, role in roles.items() if role == "training"} == {"state", "torque"}


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_feed_forward_makes_the_arm_follow(arm, drive):
    def follow(feedforward, trajectory=0):
        return rms(
            drive(arm, 250, task="track", feedforward=feedforward, trajectory=trajectory)[1:]
        )

    alone, gravity, model = follow("none"), follow("gravity"), follow("model")
    assert alone > 5 * gravity
    assert gravity > 5 * model
    assert alone > 500 * model
    assert follow("none", trajectory=1) != alone


@pytest.mark.slow
def test_predictions_act_in_their_own_period(drive):
    model = drive(DartArm, 100, task="track", feedforward="model")
    # An exact network gives the same motion, bit for bit, whatever the name of its field.
    for field in ("torque", "prediction"):
        network = drive(
            DartArm, 100, predict=lambda sample, f=field: {f: sample["torque"]}, task="track"
        )
        for one, other in zip(network, model, strict=True):
            assert one["tracking_error"] == other["tracking_error"]
    wrong = drive(DartArm, 100, predict=lambda sample: {"p": sample["torque"] + 5}, task="track")
    assert rms(wrong) > 100 * rms(model)
    ignored = drive(
        DartArm,
        100,
        predict=lambda sample: {"torque": np.full(9, 1e3)},
        task="track",
        feedforward="none",
    )
    assert rms(ignored) == rms(drive(DartArm, 100, task="track", feedforward="none"))


def test_tracking_begins_at_rest_on_the_reference_whatever_the_seed(drive):
    def begin(**options):
        environment = drive.make(DartArm, task="track", trajectory=2, **options)
        (sample,) = drive(environment, 1)
        assert sample["tracking_error"] == 0.0
        assert environment.simulation.frame == 0
        np.testing.assert_array_equal(environment.simulation.velocities(), 0.0)
        return sample["state"]

    np.testing.assert_array_equal(begin(seed=1), begin(seed=2, instance_id=3))


def test_invalid_predictions_are_named(drive):
    environment = drive.make(DartArm, task="track", prediction_field="tau")
    drive(environment, 1)
    with pytest.raises(ConfigError, match='prediction_field is "tau".*torque'):
        environment.apply_prediction({"torque": np.zeros(9), "other": np.zeros(9)})
    with pytest.raises(ConfigError, match=r"shape \(7,\), not \(9,\)"):
        environment.apply_prediction({"tau": np.zeros(7)})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"task": "dance"}, "excite, track"),
        ({"feedforward": "magic"}, "network"),
        ({"steps_per_sample": 0}, "steps_per_sample is 0"),
        ({"stiffness": [1.0, 2.0]}, "stiffness needs 9"),
        ({"frequencies": [2.0, 1.0]}, "frequencies"),
    ],
)
def test_options_are_checked(options, words):
    with pytest.raises(ConfigError, match=words):
        DartArm(**options)


def test_an_unknown_option_is_named():
    with pytest.raises(UnknownOptionError, match='"taks". Did you mean "task"'):
        DartArm(taks="track")
    with pytest.raises(ConfigError, match="at least 1"):
        DartDoublePendulum(episode_steps=0)


class Viewer:
    """Stands for the run: takes what the environments show."""

    def __init__(self):
        self.shown = []

    def show(self, instance_id, step, events):
        self.shown.append((step, [event for event in events if event.kind != "time"]))


def watch(environment):
    viewer = Viewer()
    environment._services = viewer
    environment.factory = Factory()
    environment.init_visualization()
    environment.update_visualization()
    return viewer.shown


def test_the_arm_and_its_reference_are_drawn(drive):
    environment = drive.make(DartArm, task="track", feedforward="none", draw_every=2)
    shown = watch(environment)
    added = {event.name: event for event in shown[0][1]}
    assert added.keys() == {"arm", "reference", "tracking_error", "task"}
    assert added["reference"].values["alpha"] < 1
    assert len(added["arm"].values["bodies"]) == len(environment.simulation.layout.bodies)
    drive(environment, 40)
    assert len(shown) == 21
    step, events = shown[-1]
    updated = {event.name: event.values for event in events}
    assert step == 39
    assert updated.keys() == {"arm", "reference", "tracking_error"}
    poses = environment.simulation.body_poses()
    np.testing.assert_array_equal(updated["arm"]["poses"], poses)
    assert np.abs(updated["reference"]["poses"] - poses).max() > 1e-4


def test_the_pendulum_is_drawn(drive):
    environment = drive.make(DartDoublePendulum)
    shown = watch(environment)
    drive(environment, 2)
    assert [event.name for _, events in shown for event in events] == ["pendulum"] * 3


@pytest.mark.parametrize(
    ("environment", "options"),
    [(DartArm, {}), (DartArm, {"task": "track"}), (DartDoublePendulum, {})],
)
def test_stored_samples_are_replayed(environment, options, drive):
    stored = drive(environment, 5, **options)
    viewer = drive.make(environment, **options)
    shown = watch(viewer)
    for sample in stored:
        viewer.sample = sample
        (replayed,) = drive(viewer, 1)
        for name, value in sample.items():
            np.testing.assert_array_equal(replayed[name], value)
    assert len(shown) == 6


def test_without_the_robots_the_arm_names_the_package_to_install(monkeypatch):
    found = importlib.metadata.distribution

    def missing(name):
        if name == "physx-core":  # tells where to install from
            return found(name)
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    with pytest.raises(ModelError, match=r'pip install .*physx.sim\[robots\]"'):
        DartArm().create()


def test_derivatives_of_a_smooth_trajectory_are_right():
    rng = np.random.default_rng(0)
    motion = SmoothTrajectory.draw(
        rng, np.array([1.0, -2.0]), np.array([0.5, 0.1]), (0.2, 0.8), fade_time=1.5
    )
    q, v, a = motion.at(0.0)
    np.testing.assert_array_equal([q, v, a], [[1, -2], [0, 0], [0, 0]])
    for time in (0.3, 1.2, 1.5, 4.0):
        h = 1e-5
        (q1, v1, _), (q2, v2, _) = motion.at(time - h), motion.at(time + h)
        _, v, a = motion.at(time)
        np.testing.assert_allclose((q2 - q1) / (2 * h), v, atol=1e-7)
        np.testing.assert_allclose((v2 - v1) / (2 * h), a, atol=1e-3)
    far, _, _ = motion.along(np.linspace(0, 60, 5000))
    assert (np.abs(far - motion.center) <= [0.5, 0.1]).all()
