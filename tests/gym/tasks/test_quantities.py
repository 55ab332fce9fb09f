"""Quantities agree with independently computed values, on both engines."""

import pickle

import numpy as np
import pinocchio as pin
import pytest

from physx_core import rotations
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_gym import RobotEnv, Simulator
from physx_gym.env.layers.composed import ComposedEnv
from physx_gym.tasks.quantities import (
    BaseHeight,
    BaseVelocity,
    BodiesInContact,
    BodyOrientations,
    BodyPoses,
    BodyPositions,
    BodyVelocities,
    CapturePoint,
    CenterOfMass,
    CenterOfMassVelocity,
    Computed,
    ContactForces,
    Delta,
    HighestContactForce,
    Joined,
    JointPositions,
    JointTorques,
    JointVelocities,
    LimitDistances,
    Masked,
    Mean,
    MeanBodyVelocities,
    MeanOdometry,
    MeanPose,
    MechanicalPower,
    Momentum,
    Odometry,
    OdometryVelocity,
    Rate,
    Reference,
    RelativePoses,
    RollPitch,
    SlipVelocity,
    Stacked,
    VerticalForceShares,
    ZeroMomentPoint,
    geometry,
)
from physx_gym.tasks.quantities.quantity import Quantity
from physx_gym.tasks.trajectory import Trajectory
from physx_sim.engines import find_robot
from physx_sim.errors import FeatureNotSupportedError

SHINS = ("back_left_shin", "back_right_shin", "front_left_shin", "front_right_shin")
ENGINES = ("dart", "pinocchio")


def ant(backend="dart", **options):
    options = {"period": 2e-3, "control_period": 0.01, **options}
    return RobotEnv(Simulator.build("ant", fixed_base=False, backend=backend, **options), 0.02)


@pytest.fixture(params=ENGINES)
def env(request):
    """An ant that moved a little."""
    made = ant(request.param)
    made.reset(seed=0)
    walk(made, 8)
    yield made
    made.close()


def walk(env, steps):
    rng = np.random.default_rng(1)
    for _ in range(steps):
        env.step(rng.uniform(-0.3, 0.3, env.action_space.shape) * env.action_space.high)


def model_of(env):
    model = pin.buildModelFromUrdf(str(find_robot("ant")), pin.JointModelFreeFlyer())
    data = model.createData()
    pin.forwardKinematics(model, data, env.robot_state.q, env.robot_state.v)
    pin.updateFramePlacements(model, data)
    return model, data


def value(env, quantity):
    return env.quantities.get_value(quantity)


def test_bodies_are_where_the_kinematics_say(env):
    model, data = model_of(env)
    for row, name in enumerate(SHINS):
        frame = model.getFrameId(name)
        place = data.oMf[frame]
        pose = value(env, BodyPoses(SHINS))[row]
        np.testing.assert_allclose(pose[:3], place.translation, atol=1e-9)
        matrix = value(env, BodyOrientations(SHINS, "matrix"))[row]
        np.testing.assert_allclose(matrix, place.rotation, atol=1e-9)
        angles = value(env, BodyOrientations(SHINS, "roll_pitch_yaw"))[row]
        np.testing.assert_allclose(angles, pin.rpy.matrixToRpy(place.rotation), atol=1e-9)
        for kind, reference in (
            ("world", pin.ReferenceFrame.LOCAL_WORLD_ALIGNED),
            ("body", pin.ReferenceFrame.LOCAL),
        ):
            wanted = pin.getFrameVelocity(model, data, frame, reference).vector
            found = value(env, BodyVelocities(SHINS, kind))[row]
            np.testing.assert_allclose(found, wanted, atol=1e-8)
    np.testing.assert_array_equal(
        value(env, BodyPositions(SHINS)), value(env, BodyPoses(SHINS))[:, :3]
    )


def test_the_base(env):
    q, v = env.robot_state.q, env.robot_state.v
    turn = pin.Quaternion(q[3:7]).matrix()
    roll, pitch, yaw = pin.rpy.matrixToRpy(turn)
    np.testing.assert_allclose(value(env, RollPitch()), [roll, pitch], atol=1e-9)
    np.testing.assert_allclose(value(env, Odometry()), [q[0], q[1], yaw], atol=1e-9)
    np.testing.assert_allclose(value(env, BaseVelocity()), v[:6], atol=1e-8)
    assert value(env, BaseHeight()) == pytest.approx(q[2], abs=1e-9)
    lowest = value(env, BodyPositions(SHINS))[:, 2].min()
    assert value(env, BaseHeight(SHINS)) == pytest.approx(q[2] - lowest)


def test_mass_and_momentum_are_those_of_all_links(env):
    model, data = model_of(env)
    center = pin.centerOfMass(model, data, env.robot_state.q, env.robot_state.v)
    np.testing.assert_allclose(value(env, CenterOfMass()), center, atol=1e-9)
    np.testing.assert_allclose(value(env, CenterOfMassVelocity()), data.vcom[0], atol=1e-8)
    wanted = pin.computeCentroidalMomentum(model, data, env.robot_state.q, env.robot_state.v)
    np.testing.assert_allclose(value(env, Momentum()), wanted.vector, atol=1e-7)
    pace = np.sqrt(center[2] / 9.81)
    np.testing.assert_allclose(value(env, CapturePoint()), center[:2] + data.vcom[0][:2] * pace)


def test_joints_torques_and_power(env):
    positions, velocities = value(env, JointPositions()), value(env, JointVelocities())
    np.testing.assert_array_equal(positions, env.robot_state.q[7:])
    np.testing.assert_array_equal(velocities, env.robot_state.v[6:])
    name = env.simulator.motors[2].joint
    assert value(env, JointPositions((name,))).tolist() == [positions[2]]
    torques = value(env, JointTorques())
    np.testing.assert_allclose(torques, env.robot_state.command, atol=1e-12)
    power = torques * velocities
    assert value(env, MechanicalPower("regained")) == pytest.approx(power.sum())
    assert value(env, MechanicalPower("shared")) == pytest.approx(max(power.sum(), 0.0))
    assert value(env, MechanicalPower("lost")) == pytest.approx(power[power > 0].sum())
    assert value(env, MechanicalPower("penalized")) == pytest.approx(np.abs(power).sum())
    layout = env.simulator.layout
    wanted = np.minimum(positions - layout.lower, layout.upper - positions)
    np.testing.assert_allclose(value(env, LimitDistances()), wanted)


@pytest.mark.parametrize("backend", ENGINES)
def test_feet_carry_the_weight_of_a_robot_that_stands(backend):
    env = ant(backend)
    env.reset(seed=0)
    feet = tuple(env.simulator.layout.bodies)
    for _ in range(60):
        env.step(np.zeros(8))
    shares = value(env, VerticalForceShares(feet))
    assert shares.sum() == pytest.approx(1.0, abs=1e-3)
    forces = value(env, ContactForces(feet))
    assert value(env, HighestContactForce(feet)) == np.linalg.norm(forces, axis=1).max()
    assert value(env, SlipVelocity(feet)) < 1e-2
    center = value(env, CenterOfMass())
    np.testing.assert_allclose(value(env, ZeroMomentPoint()), center[:2], atol=2e-3)
    assert value(env, BodiesInContact((*SHINS, "ground")))
    assert not value(env, BodiesInContact(SHINS))


def test_means_and_relative_poses(env):
    poses = value(env, BodyPoses(SHINS))
    mean = value(env, MeanPose(SHINS))
    np.testing.assert_allclose(mean[:3], poses[:, :3].mean(axis=0))
    relative = value(env, RelativePoses(SHINS))
    np.testing.assert_allclose(relative[:, :3].sum(axis=0), 0.0, atol=1e-12)
    turn = pin.Quaternion(mean[3:]).matrix()
    np.testing.assert_allclose(relative[1, :3], turn.T @ (poses[1, :3] - mean[:3]), atol=1e-12)
    x, y, yaw = value(env, MeanOdometry(SHINS))
    assert (x, y) == pytest.approx(tuple(mean[:2]))
    assert yaw == pytest.approx(pin.rpy.matrixToRpy(turn)[2])


def test_equal_quantities_are_computed_once_a_state(env):
    calls = []

    class Counting(Quantity):
        def __hash__(self):
            return 7

        def __eq__(self, other):
            return isinstance(other, Counting)

        def compute(self, moment):
            calls.append(moment.t)
            return moment.t

    together = Joined((Counting(), Masked(Counting(), (0,))))
    assert value(env, together).tolist() == [env.stepper_state.t] * 2
    assert value(env, Computed(np.add, (Counting(), Counting()))) == 2 * env.stepper_state.t
    assert len(calls) == 1
    walk(env, 1)
    value(env, Counting())
    assert len(calls) == 2


def test_memories_count_steps_and_start_with_the_episode():
    env = ant()
    height = BaseHeight()
    env.quantities.add("rise", Delta(height))
    env.quantities.add("last", Stacked(height, 3))
    env.quantities.add("mean", Mean(height, 3))
    env.quantities.add("pace", Rate(height))
    env.quantities.add("odometry", OdometryVelocity())
    env.quantities.add("bodies", MeanBodyVelocities(SHINS))
    assert set(env.quantities) == {"rise", "last", "mean", "pace", "odometry", "bodies"}
    for seed in (0, 1):
        env.reset(seed=seed)
        heights = [value(env, height)]
        assert env.quantities["rise"] == 0.0
        assert env.quantities["last"].tolist() == heights
        for _ in range(5):
            before = value(env, BodyPoses(SHINS))
            walk(env, 1)
            heights.append(value(env, height))
            assert env.quantities["rise"] == pytest.approx(heights[-1] - heights[-2])
        assert env.quantities["last"].tolist() == heights[-3:]
        assert env.quantities["mean"] == pytest.approx(np.mean(heights[-3:]))
        assert env.quantities["pace"] == pytest.approx((heights[-1] - heights[-2]) / 0.02)
        moved = value(env, BodyPoses(SHINS)) - before
        np.testing.assert_allclose(env.quantities["bodies"][:, :3], moved[:, :3] / 0.02)


def test_a_snapshot_holds_memories():
    env = ant()
    env.quantities.add("last", Stacked(BaseHeight(), 4))
    env.reset(seed=0)
    walk(env, 3)
    state = pickle.loads(pickle.dumps(env.snapshot()))  # noqa: S301 - our own
    walk(env, 3)
    later = env.quantities["last"].copy()
    env.restore(state)
    assert len(env.quantities["last"]) == 4
    walk(env, 3)
    np.testing.assert_array_equal(env.quantities["last"], later)


def test_the_reference_is_another_state_of_the_same_robot():
    env = ant()
    env.reset(seed=0)
    q, v = env.robot_state.q.copy(), env.robot_state.v.copy()
    higher, later = q.copy(), q.copy()
    higher[2] += 1.0
    later[2] += 2.0
    path = Trajectory(np.array([0.0, 1.0]), np.array([higher, later]), np.array([v, v]), "clip")
    top = ComposedEnv(env, trajectory=path)
    top.reset(seed=0)
    top.step(np.zeros(8))
    assert value(env, Reference(BaseHeight())) == pytest.approx(q[2] + 1.02)
    shift = value(env, Reference(BodyPositions(SHINS))) - value(env, BodyPositions(SHINS))
    assert shift[:, 2].min() > 0.9
    center = value(env, Reference(CenterOfMass()))
    assert center[2] - value(env, CenterOfMass())[2] == pytest.approx(1.02, abs=1e-2)
    with pytest.raises(FeatureNotSupportedError, match="contacts"):
        value(env, Reference(ContactForces(SHINS)))
    with pytest.raises(ConfigError, match="depends on previous steps"):
        value(env, Reference(Delta(BaseHeight())))


def test_mistakes_are_named(env):
    with pytest.raises(ComponentNotFoundError, match="wings"):
        env.quantities["wings"]
    with pytest.raises(ConfigError, match="not a Quantity"):
        env.quantities.add("height", 3)
    env.quantities.add("height", BaseHeight())
    env.quantities.add("height", BaseHeight())
    with pytest.raises(ConfigError, match="is already a quantity"):
        env.quantities.add("height", RollPitch())
    env.quantities.remove("height")
    assert "height" not in env.quantities
    with pytest.raises(ComponentNotFoundError, match="knee"):
        value(env, JointPositions(("knee",)))
    with pytest.raises(ComponentNotFoundError, match="wheel"):
        value(env, ContactForces(("wheel",)))
    with pytest.raises(ConfigError, match="no trajectory"):
        value(env, Reference(BaseHeight()))
    with pytest.raises(ConfigError, match="at least two"):
        RelativePoses(("torso",))
    with pytest.raises(ConfigError, match="braking"):
        MechanicalPower("gone")
    with pytest.raises(ConfigError, match="at least 1"):
        Stacked(BaseHeight(), 0)


def test_a_fixed_base_has_no_center_of_mass():
    env = RobotEnv(Simulator.build("cartpole"), 0.02)
    env.reset(seed=0)
    with pytest.raises(FeatureNotSupportedError, match="center of mass"):
        value(env, CenterOfMass())


def test_rotations_agree_with_pinocchio():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(200, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    matrices = [pin.Quaternion(row).matrix() for row in q]
    logs = np.array([pin.log3(matrix) for matrix in matrices])
    np.testing.assert_allclose(rotations.to_matrix_rows(q), matrices, atol=1e-12)
    np.testing.assert_allclose(rotations.to_rotation_vector_rows(q), logs, rtol=1e-7, atol=1e-9)
    small = np.array([[1e-9, 0.0, 0.0, 1.0]])
    np.testing.assert_allclose(rotations.to_rotation_vector_rows(small), [[2e-9, 0, 0]], rtol=1e-6)
    angles = np.array([pin.rpy.matrixToRpy(matrix) for matrix in matrices])
    np.testing.assert_allclose(rotations.to_roll_pitch_yaw_rows(q), angles, rtol=1e-7, atol=1e-9)
    mean = rotations.mean(np.array([[0, 0, np.sin(a), np.cos(a)] for a in (0.1, 0.2, 0.3)]))
    np.testing.assert_allclose(mean, [0, 0, np.sin(0.2), np.cos(0.2)], atol=1e-12)
    step = geometry.odometry_difference(np.array([1.0, 1.0, np.pi / 2]), np.zeros(3))
    np.testing.assert_allclose(step, [np.sqrt(2), 0.0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(geometry.angle_difference(3.1, -3.1), 6.2 - 2 * np.pi)
