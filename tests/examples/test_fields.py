"""The flow on a grid and the heat in a mesh are right, and the graph network keeps to its mesh."""

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig

torch = pytest.importorskip("torch")


@pytest.fixture
def simulate(tmp_path):
    """Return fields of some samples of an environment, shape (rows, ...) each."""

    def simulate(environment, *fields, name="session", rows=3):
        generation = DataGeneration(
            EnvironmentConfig(environment, as_tcp_ip_client=False, seed=1),
            session_dir=str(tmp_path),
            session_name=name,
            batch_nb=1,
            batch_size=rows,
        )
        generation.execute()
        with Dataset.open(generation.session.path) as dataset:
            return [dataset["training"][field][:] for field in fields]

    return simulate


def change_of(environment, vorticity):
    """Return how fast a vorticity changes, both on the grid."""
    return np.fft.ifft2(environment.change(np.fft.fft2(vorticity))).real


@pytest.fixture
def flow(module):
    """An environment of vortices, created, and the places of its points along one side."""
    vortices = module("environments.vortices")
    environment = vortices.Vortices.__new__(vortices.Vortices)
    environment.create()
    return environment, np.arange(vortices.POINTS) / vortices.POINTS


def test_vortices_that_stand_still_only_decay(flow):
    """A grid of equal vortices is an exact solution of Taylor and Green."""
    environment, places = flow
    wave = 4 * np.pi
    vorticity = np.sin(wave * places)[:, None] * np.sin(wave * places)
    decay = -environment.VISCOSITY * 2 * wave**2 * vorticity
    np.testing.assert_allclose(change_of(environment, vorticity), decay, atol=1e-12)


def test_a_flow_carries_vorticity_along_with_it(flow):
    """Beside a flow u = (sin 2 pi y, 0), a small wave p(x) changes by -u p_x - v w_y."""
    environment, places = flow
    x, y, small = places[:, None], places[None], 1e-3
    shear = -2 * np.pi * np.cos(2 * np.pi * y) + 0 * x
    wave = 6 * np.pi
    ripple = np.sin(wave * x) + 0 * y
    found = change_of(environment, shear + small * ripple) - change_of(environment, shear)
    carried = np.sin(2 * np.pi * y) * wave * np.cos(wave * x)
    lifted = -np.cos(wave * x) / wave * (2 * np.pi) ** 2 * np.sin(2 * np.pi * y)
    exact = -carried - lifted - environment.VISCOSITY * wave**2 * ripple
    np.testing.assert_allclose(found / small, exact, atol=1e-9)


@pytest.mark.slow
def test_shorter_steps_lead_to_the_same_flow(module, simulate):
    vortices = module("environments.vortices").Vortices
    finer = type("Finer", (vortices,), {"STEPS": 40, "PERIOD": 0.025})
    now, coarse = simulate(vortices, "now", "later", name="coarse")
    same, fine = simulate(finer, "now", "later", name="fine")
    np.testing.assert_array_equal(now, same)
    assert np.abs(fine - now).max() > 0.5
    np.testing.assert_allclose(coarse, fine, atol=5e-4)


@pytest.fixture
def plate(module):
    pytest.importorskip("scipy", reason="needs scipy for the mesh and its heat")
    return module("environments.plate")


@pytest.mark.parametrize("shape", ["hole", "corner"])
@pytest.mark.parametrize("space", [0.05, 0.25])
def test_triangles_fill_the_plate_and_leave_what_it_lacks(shape, space, plate):
    nodes, triangles = plate.mesh(shape, space, np.random.default_rng(0))
    first, second, third = nodes[triangles].swapaxes(0, 1)
    (a, b), (c, d) = (second - first).T, (third - first).T
    areas = (a * d - b * c) / 2
    assert areas.min() > space**2 / 12
    rim = np.isclose(np.linalg.norm(nodes - plate.SIDE / 2, axis=1), plate.RADIUS).sum()
    hole = rim * plate.RADIUS**2 * np.sin(2 * np.pi / max(1, rim)) / 2  # a regular polygon
    lacks = hole if shape == "hole" else plate.SIDE**2 / 4
    assert areas.sum() == pytest.approx(plate.SIDE**2 - lacks)
    assert set(triangles.ravel()) == set(range(len(nodes)))


def test_no_heat_leaves_the_plate_and_differences_fade(plate, simulate):
    names = ("place", "triangle", "edge", "before", "after")
    plates = list(zip(*simulate(plate.Plate, *names), strict=True))
    assert len({len(nodes) for nodes, *_ in plates}) > 1
    for nodes, triangles, edges, before, after in plates:
        first, second, third = nodes[triangles].swapaxes(0, 1)
        (a, b), (c, d) = (second - first).T, (third - first).T
        masses = np.zeros(len(nodes))
        np.add.at(masses, triangles, ((a * d - b * c) / 6)[:, None])
        temperature, conductivity = before.T
        assert conductivity.min() > 0
        assert after[:, 0] @ masses == pytest.approx(temperature @ masses, abs=1e-6)
        assert np.ptp(after) < np.ptp(temperature)
        sides = {tuple(sorted(t[[i, i - 1]])) for t in triangles for i in range(3)}
        assert {tuple(each) for each in edges} == sides and len(edges) == len(sides)


@pytest.fixture
def network(plate, module):
    """A graph network for heat with random weights."""
    pytest.importorskip("torch_geometric", reason="needs torch-geometric")
    torch.manual_seed(0)
    made = module("networks.heat").HeatNetwork(channels=8, steps=2).double()
    torch.nn.init.zeros_(made.last.bias)
    return made


@pytest.fixture
def mesh(plate):
    """Nodes, triangles and edges of a plate, as tensors but for the triangles."""
    nodes, triangles = plate.mesh("hole", 0.1, np.random.default_rng(0))
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, 1:], triangles[:, ::2]])
    edges = np.unique(np.sort(sides), axis=0)
    return torch.from_numpy(nodes), triangles, torch.from_numpy(edges).long()


@pytest.mark.slow
def test_a_node_hears_of_others_as_far_as_there_are_steps(network, mesh):
    """With two steps, warmth comes from nodes at most two edges away; conductivity from three."""
    nodes, triangles, edges = mesh
    near = np.eye(len(nodes), dtype=bool)
    for triangle in triangles:
        near[np.ix_(triangle, triangle)] = True
    values = torch.randn(len(nodes), 2, dtype=torch.double, requires_grad=True)
    network(nodes, edges, values)[0, 0].backward()
    temperature, conductivity = (values.grad != 0).numpy().T
    reach = [np.linalg.matrix_power(near.astype(int), hops)[0] > 0 for hops in (1, 2, 3)]
    np.testing.assert_array_equal(temperature, reach[1])
    assert not np.any(conductivity & ~reach[2]) and np.any(conductivity & ~reach[0])


@pytest.mark.slow
def test_a_plate_of_one_temperature_stays_as_it_is_and_no_mesh_touches_another(network, mesh):
    nodes, _, edges = mesh
    values = torch.randn(len(nodes), 2, dtype=torch.double)
    values[:, 0] = 1.5
    assert torch.allclose(network(nodes, edges, values), torch.tensor(1.5, dtype=torch.double))
    warmer = values.clone()
    warmer[:5, 0] = 2
    warm = network(nodes, edges, warmer)
    assert torch.all((warm > 1.5 - 1e-9) & (warm <= 2)) and warm.max() > 1.6
    both = network(
        torch.cat([nodes, nodes]),
        torch.cat([edges, edges + len(nodes)]),
        torch.cat([values, warmer]),
    )
    torch.testing.assert_close(both[len(nodes) :], warm)
    assert torch.allclose(both[: len(nodes)], torch.tensor(1.5, dtype=torch.double))
