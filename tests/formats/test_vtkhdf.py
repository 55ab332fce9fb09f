"""VTKHDF files have mesh, fields and time, as VTK itself reads them."""

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig, Field
from physx_core.errors import ConfigError
from physx_formats import ExchangeError, ExportOptions, export

RNG = np.random.default_rng(0)
TRIANGLES = np.array([[0, 1, 2], [1, 3, 2]])
SQUARE = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)


def read(path):
    """Return time, points, cells, and the data of points and of cells, at each step."""
    io = pytest.importorskip("vtkmodules.vtkIOHDF", reason="vtk is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

    reader = io.vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(Pipeline.TIME_STEPS())
    for number, time in enumerate(times):
        reader.SetStep(number)
        reader.Update()
        grid = reader.GetOutputDataObject(0)
        cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
        kinds = {grid.GetCellType(k) for k in range(grid.GetNumberOfCells())}
        data = []
        for of in (grid.GetPointData(), grid.GetCellData()):
            names = [of.GetArrayName(k) for k in range(of.GetNumberOfArrays())]
            data.append({n: vtk_to_numpy(of.GetArray(n)) for n in names if n != "vtkGhostType"})
        yield time, vtk_to_numpy(grid.GetPoints().GetData()), cells, kinds, *data


class Plate(Environment):
    """Two triangles whose size each episode has for itself."""

    independent_episodes, episode_steps = True, 3

    def create(self):
        self.size = 1.0

    def init_database(self):
        self.define_training_fields([Field("u", (4,)), Field("flow", (4, 2)), Field("heat", (2,))])
        self.define_additional_fields([Field("load", (), unit="N")])
        self.define_episode_fields([Field("nodes", (4, 2), unit="m"), Field("mesh", (2, 3), int)])

    def reset_parameters(self):
        self.size = self.rng.uniform(1, 2)
        self.set_episode_data(nodes=self.size * SQUARE, mesh=TRIANGLES)

    def step(self):
        u = self.rng.normal(size=4)
        self.set_training_data(u=u, flow=np.stack([u, -u], 1), heat=u[:2])
        self.set_additional_data(load=1.0)


def test_a_mesh_that_episodes_have_once_moves_its_fields_in_time(tmp_path):
    run = DataGeneration(
        EnvironmentConfig(Plate, as_tcp_ip_client=False, seed=0), episodes=4,
        session_dir=str(tmp_path), session_name="run", quiet=True,
    )  # fmt: skip
    run.execute()
    options = ExportOptions(points="nodes", cells="mesh", fps=10)
    with Dataset.open(run.session.path) as dataset:
        with pytest.warns(UserWarning, match="env_id, episode, .*load.* are left out"):
            export(dataset, "vtkhdf", tmp_path / "out.vtkhdf", options=options)
        rows, once = dataset["training"], dataset.episode_table(["training"])
        steps = list(read(tmp_path / "out.vtkhdf"))
        assert [time for time, *_ in steps] == pytest.approx([0.1 * k for k in range(12)])
        nodes = np.repeat(once["nodes"], once["rows"], axis=0)
        assert np.ptp(nodes[:, 3, 0]) > 0  # they differ
        for k, (_, points, cells, kinds, by_point, by_cell) in enumerate(steps):
            np.testing.assert_array_equal(points[:, :2], nodes[k])
            assert not points[:, 2].any() and kinds == {5}
            assert cells.tolist() == TRIANGLES.reshape(-1).tolist()
            np.testing.assert_array_equal(by_point["u"], rows["u"][k])
            np.testing.assert_array_equal(by_point["flow"][:, :2], rows["flow"][k])
            np.testing.assert_array_equal(by_cell["heat"], rows["heat"][k])


@pytest.mark.parametrize(
    ("size", "by_cell", "cell_type", "kind"),
    [(2, 4, None, 9), (3, 4, None, 10), (3, 4, "quad", 9), (3, 8, None, 12), (1, 2, None, 3)],
)
def test_points_may_move_and_cells_change_with_each_row(size, by_cell, cell_type, kind, tmp_path):
    points = RNG.normal(size=(5, 9, size)).astype(np.float32)
    cells = RNG.integers(0, 9, (5, 4, by_cell), np.int32)
    u = RNG.normal(size=(5, 9, 3, 3))
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.append("training", {"x": points, "c": cells, "u": u, "on": u[..., 0, 0] > 0})
        options = ExportOptions(points="x", cells="c", cell_type=cell_type)
        export(dataset, "vtkhdf", tmp_path / "out.vtkhdf", options=options)
    for k, (time, found, links, kinds, by_point, _) in enumerate(read(tmp_path / "out.vtkhdf")):
        assert time == k and kinds == {kind}
        np.testing.assert_array_equal(found[:, :size], points[k])
        np.testing.assert_array_equal(links, cells[k].reshape(-1))
        np.testing.assert_array_equal(by_point["u"], u[k].reshape(9, 9))
        np.testing.assert_array_equal(by_point["on"], u[k, :, 0, 0] > 0)


def test_points_without_cells_are_a_cloud(tmp_path):
    with Dataset.create(tmp_path / "set") as dataset:
        points = RNG.normal(size=(2, 6, 3))
        dataset.append("training", {"x": points})
        export(dataset, "vtkhdf", tmp_path / "out.vtkhdf", options=ExportOptions(points="x", fps=1))
    for k, (_, found, links, kinds, *_) in enumerate(read(tmp_path / "out.vtkhdf")):
        np.testing.assert_array_equal(found, points[k])
        assert links.tolist() == list(range(6)) and kinds == {1}


def mesh_of(nodes):
    """Return a strip of triangles over some nodes."""
    return RNG.normal(size=(nodes, 2)), np.arange(nodes - 2)[:, None] + np.arange(3)


def test_meshes_of_any_size_come_one_after_another(tmp_path):
    sizes, fields = (3, 7, 5, 4), [
        Field("x", ("node", 2)), Field("mesh", ("cell", 3), int, indexes="node"),
        Field("u", ("node", 2)), Field("heat", ("cell",)), Field("wrong", ("probe",)),
    ]  # fmt: skip
    meshes = [mesh_of(size) for size in sizes]
    rows = {
        "x": [x for x, _ in meshes], "mesh": [cells for _, cells in meshes],
        "u": [RNG.normal(size=(size, 2)) for size in sizes],
        "heat": [RNG.normal(size=size - 2) for size in sizes],
        "wrong": [np.zeros(size) for size in sizes],
    }  # fmt: skip
    options = ExportOptions(points="x", cells="mesh")
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.define_fields("training", fields)
        dataset.append("training", rows)
        with pytest.warns(UserWarning, match="wrong are left out|wrong is left out"):
            export(dataset, "vtkhdf", tmp_path / "out.vtkhdf", options=options)
    steps = list(read(tmp_path / "out.vtkhdf"))
    assert len(steps) == len(sizes)
    for k, (time, points, cells, kinds, by_point, by_cell) in enumerate(steps):
        assert time == k and kinds == {5}
        np.testing.assert_array_equal(points[:, :2], rows["x"][k])
        np.testing.assert_array_equal(cells, rows["mesh"][k].reshape(-1))
        np.testing.assert_array_equal(by_point["u"][:, :2], rows["u"][k])
        np.testing.assert_array_equal(by_cell["heat"], rows["heat"][k])


class Strip(Environment):
    """A strip of triangles of which each episode has another number."""

    independent_episodes, episode_steps = True, 2

    def create(self):
        self.size = 3

    def init_database(self):
        self.define_training_fields([Field("u", ("node",))])
        mesh = Field("mesh", ("cell", 3), int, indexes="node")
        self.define_episode_fields([Field("nodes", ("node", 2)), mesh])

    def reset_parameters(self):
        self.size = int(self.rng.integers(3, 9))
        cells = np.arange(self.size - 2)[:, None] + np.arange(3)
        self.set_episode_data(nodes=self.rng.normal(size=(self.size, 2)), mesh=cells)

    def step(self):
        self.set_training_data(u=self.rng.normal(size=self.size))


def test_episodes_have_meshes_of_any_size(tmp_path):
    run = DataGeneration(
        EnvironmentConfig(Strip, as_tcp_ip_client=False, seed=0), episodes=5,
        session_dir=str(tmp_path), session_name="run", quiet=True,
    )  # fmt: skip
    run.execute()
    options = ExportOptions(points="nodes", cells="mesh")
    with Dataset.open(run.session.path) as dataset:
        with pytest.warns(UserWarning, match="left out"):
            export(dataset, "vtkhdf", tmp_path / "out.vtkhdf", options=options)
        once = dataset.episode_table(["training"])
        place, u = np.repeat(np.arange(len(once["rows"])), once["rows"]), dataset["training"]["u"]
        steps = list(read(tmp_path / "out.vtkhdf"))
        assert len(steps) == 10 and len({len(points) for _, points, *_ in steps}) > 2
        for k, (_, points, cells, _, by_point, _) in enumerate(steps):
            np.testing.assert_array_equal(points[:, :2], once["nodes"][place[k]])
            np.testing.assert_array_equal(cells, once["mesh"][place[k]].reshape(-1))
            np.testing.assert_array_equal(by_point["u"], u[k])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({}, r"the field with the points of the mesh.*Such fields: .*x"),
        ({"points": "y"}, 'no field "y" of such a shape'),
        ({"points": "u"}, '"u" has 4 numbers for each point, not 1 to 3'),
        ({"points": "x", "cells": "k"}, 'no field "k".*Such fields: '),
        ({"points": "x", "cells": "c", "cell_type": "quad"}, "3 points for each cell.*no quad"),
        ({"points": "x", "cells": "x"}, '"x" has no numbers of points, but float64'),
        ({"points": "x", "cells": "c"}, "names points from 0 to 9, but there are 6"),
    ],
)
def test_what_is_no_mesh_is_refused(options, reason, tmp_path):
    rows = {
        "x": RNG.normal(size=(2, 6, 3)),
        "u": np.zeros((2, 6, 4)),
        "c": np.zeros((2, 2, 3), int),
    }
    rows["c"][1, 1] = 0, 1, 9
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.append("training", rows)
        with pytest.raises((ConfigError, ExchangeError), match=reason):
            export(dataset, "vtkhdf", tmp_path / "out", options=ExportOptions(**options))
    assert {path.name for path in tmp_path.iterdir()} == {"set"}
