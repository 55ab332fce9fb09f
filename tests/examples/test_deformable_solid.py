"""The bending beam of the example: its solver, its samples, and what it shows."""

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.components import Factory
from physx_core.errors import WrongSamplesError


@pytest.fixture
def beam(root, monkeypatch):
    """The module of the solver."""
    pytest.importorskip("felupe", reason="needs felupe, which solves the beam")
    monkeypatch.syspath_prepend(str(root / "examples"))
    from environments import beam_solver

    return beam_solver


@pytest.fixture
def pushed(beam):
    """The module of the environment."""
    from environments import beam as pushed

    return pushed


def tip_load(beam, force):
    forces = np.zeros(beam.GRID)
    forces[:, :, -1, 2] = force / 16
    return forces


def tip(displacement):
    return displacement[:, :, -1, 2].mean()


def test_the_grid_is_along_z_y_x(beam):
    assert np.allclose(beam.ElasticBeam().rest[2, 1, 3], [3 / 15, 0.25 / 3, 0.5 / 3])


@pytest.mark.parametrize("way", ["linear", "solve"])
def test_the_beam_bends_as_beam_theory_says_under_small_loads(way, beam):
    displacement = getattr(beam.ElasticBeam(), way)(tip_load(beam, 0.1))
    length, _, height = beam.SIZE
    area, inertia = height**2, height**4 / 12
    shear = beam.YOUNG / (2 * (1 + beam.POISSON)) * area * 5 / 6
    theory = 0.1 * (length**3 / (3 * beam.YOUNG * inertia) + length / shear)  # Timoshenko
    assert tip(displacement) == pytest.approx(theory, rel=0.15)
    assert np.all(displacement[:, :, 0] == 0)


@pytest.mark.slow
def test_linear_elasticity_is_the_tangent_at_rest_whatever_was_solved_before(beam):
    solver = beam.ElasticBeam()
    solver.solve(tip_load(beam, 40))
    small = tip_load(beam, 1e-4)
    assert np.allclose(solver.linear(small), solver.solve(small), rtol=1e-4, atol=1e-12)
    assert np.allclose(solver.linear(1e5 * small), 1e5 * solver.linear(small))


def test_large_loads_bend_it_less_than_in_proportion(beam):
    solver = beam.ElasticBeam()
    assert (
        0.3 < tip(solver.solve(tip_load(beam, 40))) < 0.9 * tip(solver.linear(tip_load(beam, 40)))
    )
    assert np.all(solver.solve(0 * tip_load(beam, 0)) == 0)


@pytest.mark.slow
@pytest.mark.parametrize("force", [-80, 100])
def test_the_equilibrium_is_that_of_felupes_own_solver_in_small_parts(force, beam):
    import felupe

    mesh = felupe.Cube(b=beam.SIZE, n=beam.NODES)
    field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
    mu = beam.YOUNG / (2 * (1 + beam.POISSON))
    lame = beam.YOUNG * beam.POISSON / ((1 + beam.POISSON) * (1 - 2 * beam.POISSON))
    solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu, lame), field)
    load = felupe.PointLoad(field, np.arange(mesh.npoints))
    boundaries = {"clamped": felupe.Boundary(field[0], fx=0.0)}
    clamped, free = felupe.dof.partition(field, boundaries)
    forces = tip_load(beam, force)
    for part in np.linspace(0.05, 1, 20):
        load.update(part * forces.reshape(-1, 3))
        felupe.newtonraphson(
            items=[solid, load], x0=field, dof0=clamped, dof1=free, verbose=0, tol=1e-6
        )
    found = beam.ElasticBeam().solve(forces)
    assert np.allclose(found.reshape(-1, 3), field[0].values, atol=1e-4)


def test_forces_that_nothing_balances_are_refused(beam):
    solver = beam.ElasticBeam()
    with pytest.raises(beam.NoEquilibriumError):
        solver.solve(tip_load(beam, 1e6))
    assert np.all(np.isfinite(solver.solve(tip_load(beam, 1))))


def test_the_skin_is_closed_and_faces_outwards(beam):
    solver = beam.ElasticBeam()
    corners = solver.rest.reshape(-1, 3)[solver.skin]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volumes.sum() == pytest.approx(np.prod(beam.SIZE))


@pytest.mark.slow
def test_samples_are_pushes_and_their_equilibria(beam, pushed, tmp_path):
    config = EnvironmentConfig(pushed.Beam, as_tcp_ip_client=False, seed=0)
    DataGeneration(config, session_dir=str(tmp_path), batch_nb=1, batch_size=3).execute()
    solver = beam.ElasticBeam()
    with Dataset.open(tmp_path / "data_generation") as dataset:
        rows = {
            name: dataset["training"][name][:] for name in ("forces", "displacement", "correction")
        }
    for forces, displacement, correction in zip(*rows.values(), strict=True):
        pushes = np.linalg.norm(forces.sum(axis=(0, 1, 2)))
        assert 0.2 * pushed.GREATEST_FORCE <= pushes <= pushed.GREATEST_FORCE
        assert np.all(forces[1:3, 1:3, :-1] == 0) and np.all(forces[:, :, 0] == 0)  # on the skin
        assert np.allclose(displacement, 1e3 * solver.solve(forces), atol=1e-3)
        assert np.allclose(displacement - correction, 1e3 * solver.linear(forces), atol=1e-3)
    assert len({forces.tobytes() for forces in rows["forces"]}) == 3


def test_a_push_that_diverges_is_refused(beam, pushed, tmp_path, monkeypatch):
    def fail(solver, forces):
        raise beam.NoEquilibriumError

    monkeypatch.setattr(beam.ElasticBeam, "solve", fail)
    config = EnvironmentConfig(pushed.Beam, as_tcp_ip_client=False, max_wrong_samples_per_step=3)
    with pytest.raises(WrongSamplesError, match="rejected 4 samples"):
        DataGeneration(config, session_dir=str(tmp_path), batch_nb=1, batch_size=1).execute()


def test_the_beams_of_solver_network_and_linear_elasticity_are_drawn(pushed):
    env = pushed.Beam(seed=0)
    env.create()
    env.init_database()
    env.factory = Factory()
    env.init_visualization()
    env.factory.take_events()
    env.step()
    env.apply_prediction({"correction": env.exact - env.linear + 1.0})
    values = {event.name: event.values for event in env.factory.take_events()}
    rest = env.solver.rest.reshape(-1, 3)
    for name, field in (("solver", env.exact), ("network", env.exact + 1.0)):
        assert np.allclose(values[name]["positions"], rest + field.reshape(-1, 3) / 1e3, atol=1e-6)
    linear, network = values["error"]["values"]
    right = np.linalg.norm(env.exact)
    assert network == pytest.approx(np.sqrt(env.exact.size) / right)
    assert linear == pytest.approx(np.linalg.norm(env.linear - env.exact) / right)
