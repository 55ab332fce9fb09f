"""The arm of the demo follows as its environment says, whatever torque is fed forward."""

import numpy as np
import pytest

from physx_sim.engines import example_robot

pytest.importorskip("torch")
pytest.importorskip("dartpy")
pytest.importorskip("rerun")


@pytest.fixture
def arm(module):
    return module("environments.arm")


def test_a_function_that_is_exact_follows_as_the_exact_model_does(arm):
    with arm.closing(arm.DartArm(task="track")) as other:
        other.create()

        def exact(state):
            q, v, a = np.split(state[0], 3)
            return other.simulation.inverse_dynamics(q, v, a)[None]

        assert arm.tracking_error(exact, 5, 60) == arm.tracking_error("model", 5, 60) < 0.1


@pytest.mark.slow
def test_worse_torques_follow_worse(arm):
    def wrong(state):
        return np.full((len(state), 9), 5.0)

    ways = ("model", "gravity", wrong, "none")
    errors = [arm.tracking_error(way, 6, 60) for way in ways]
    assert errors[0] < errors[1] < errors[3] and errors[1] < errors[2]


def test_the_arms_side_by_side_are_those_of_the_table(arm):
    shown = [arm.ComparedArm(instance_id=number, instance_nb=3) for number in (1, 2, 3)]
    assert [each.feedforward for each in shown] == ["none", "network", "model"]
    assert {each.task for each in shown} == {"track"}


def test_least_squares_identifies_the_exact_model_if_the_geometry_is_known(arm):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(example_robot("panda_description/urdf/panda.urdf")))
    data, rows, torques = model.createData(), [], []
    with arm.closing(arm.DartArm(seed=0)) as moved:
        moved.create()
        moved.init()
        for _ in range(200):
            moved.step()
            sample = moved.take_sample()
            q, v, a = np.split(sample["state"], 3)
            rows.append(
                np.hstack([pin.computeJointTorqueRegressor(model, data, q, v, a), np.diag(v)])
            )
            torques.append(sample["torque"])
    known, unseen = np.vstack(rows[:100]), np.vstack(rows[100:])
    found = np.linalg.lstsq(known, np.hstack(torques[:100]), rcond=1e-10)[0]
    np.testing.assert_allclose(unseen @ found, np.hstack(torques[100:]), atol=1e-6)


def test_the_readme_shows_what_the_last_full_run_printed(root):
    kept = (root / "docs/examples/09_robot_arm.txt").read_text()
    *_, table, verdict = kept.strip().split("\n\n")
    assert "worst seed" in table
    assert f"```text\n{table}\n\n{verdict}\n```" in (root / "README.md").read_text()
