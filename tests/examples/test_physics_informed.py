"""The friction of the double pendulum is what its model lacks, and what a network in it learns."""

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("dartpy")
pytest.importorskip("pinocchio")
pytest.importorskip("matplotlib")


@pytest.fixture
def pendulum(module):
    return module("environments.double_pendulum")


@pytest.fixture
def engines(pendulum):
    """The pendulum with friction, and its model without."""
    with (
        pendulum.pendulum("dart", friction=True) as real,
        pendulum.pendulum("pinocchio", friction=False) as model,
    ):
        yield real, model


@pytest.mark.slow
def test_the_model_lacks_the_friction(module, pendulum, engines):
    samples = pendulum.measure(engines[0], 20, seed=3)
    friction = module("environments.double_pendulum_picture").friction
    torch.testing.assert_close(pendulum.missing(engines[1], samples), friction(samples[1]))


@pytest.mark.slow
def test_true_friction_inside_the_model_is_exact(module, pendulum, engines):
    example = module("18_physics_informed")
    samples, model = pendulum.measure(engines[0], 20, seed=3), example.ForwardDynamics(engines[1])
    friction = module("environments.double_pendulum_picture").friction

    def inside(q, v, torque):
        return example.accelerations(model, "missing torque", friction(v), q, v, torque)

    assert pendulum.error(inside, samples) < 1e-9
    assert pendulum.error(model, samples) > 0.05


@pytest.mark.slow
def test_equations_of_motion_help_a_network(module, pendulum, engines, tmp_path):
    example = module("18_physics_informed")
    model = example.ForwardDynamics(engines[1])
    known, unseen = (pendulum.measure(engines[0], rows, seed=rows) for rows in (200, 300))
    session = pendulum.store(tmp_path / "samples", known, unseen)
    errors = {
        name: pendulum.error(example.train(session, model, kind, 100, 0)[1], unseen)
        for name, kind in example.KINDS.items()
    }
    assert errors[example.NETWORK] < pendulum.error(model, unseen) / 4
    assert errors[example.NETWORK] < min(errors[name] for name in errors if "width" in name) / 10
