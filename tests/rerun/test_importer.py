"""Datasets as recordings, as Rerun gets them from the importer."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
from rerun.experimental import Hdf5Reader

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig, Field
from physx_core.cli import main as physx
from physx_rerun import dataset as drawing
from physx_rerun.importer import FOREIGN
from physx_rerun.viewer.viewer import find_executable, find_free_port

pytestmark = pytest.mark.processes

PROGRAM = f"""#!{sys.executable}
import sys
from physx_rerun.importer import main
sys.exit(main())
"""
ROWS = 12


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    owners = np.arange(ROWS, dtype=np.int32) % 2 + 1
    return {
        "cloud": rng.random((ROWS, 5, 3)),
        "outline": rng.random((ROWS, 4, 2)),
        "force": rng.random((ROWS, 3)),
        "energy": rng.random(ROWS),
        "contact": rng.random((ROWS, 2)) > 0.5,
        "heat": rng.random((ROWS, 6, 7)),
        "env_id": owners,
    }


@pytest.fixture
def folder(tmp_path, data):
    with Dataset.create(tmp_path / "dataset", session="run") as dataset:
        fields = [Field(n, shape=v.shape[1:], dtype=v.dtype.str) for n, v in data.items()]
        dataset.define_fields("training", fields)
        dataset.append("training", data)
        dataset.append("validation", {"x": np.zeros((2, 3))})
    return tmp_path / "dataset"


@pytest.fixture
def importer(tmp_path):
    """Return the path of the command, as an installed package has it."""
    (tmp_path / "bin").mkdir()
    path = tmp_path / "bin" / "rerun-importer-physx"
    path.write_text(PROGRAM)
    path.chmod(0o755)
    return path


def test_rerun_opens_a_dataset(folder, importer, data, tmp_path, read):
    out, port = tmp_path / "out.rrd", str(find_free_port())
    command = [find_executable(), folder / "run.h5", "--save", out, "--bind", "127.0.0.1"]
    paths = {"PATH": f"{importer.parent}:{os.environ['PATH']}"}
    subprocess.run([*command, "--port", port], env=os.environ | paths, check=True, timeout=60)
    assert rr.chunk.RrdReader(out).blueprints()
    for instance in (1, 2):
        place, rows = f"/training/env_{instance}", list(range(instance - 1, ROWS, 2))
        for name, component in (
            ("cloud", "Points3D:positions"),
            ("outline", "Points2D:positions"),
            ("force", "Scalars:scalars"),
            ("energy", "Scalars:scalars"),
            ("contact", "Scalars:scalars"),
        ):
            found = read(out, f"{place}/{name}", component, "row")
            found = [pair for pair in found if pair[0] is not None]
            assert [row for row, _ in found] == rows
            values = np.array([value for _, value in found]).reshape(data[name][rows].shape)
            np.testing.assert_allclose(values, data[name][rows], rtol=1e-6)
        tensors = read(out, f"{place}/heat", "Tensor:data", "row")
        assert [row for row, _ in tensors] == rows
    assert read(out, "/validation/env_1/x", "Scalars:scalars", "row") == [
        (0, [0] * 3),
        (1, [0] * 3),
    ]


def test_files_of_others_are_refused_without_importing_anything(importer, tmp_path):
    (tmp_path / "other.h5").write_bytes(b"")
    code = "import sys; from physx_rerun import importer; status = importer.main(); "
    code += "print({'rerun', 'numpy', 'physx_core'} & sys.modules.keys()); sys.exit(status)"
    for name in ("other.h5", "photo.png", "missing", "."):
        command = [sys.executable, "-c", code, tmp_path / name, "--application-id", "a"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (ended.returncode, ended.stdout, ended.stderr) == (FOREIGN, "set()\n", "")


def test_a_damaged_dataset_is_an_error(folder, importer):
    (folder / "dataset.json").write_text("{")
    ended = subprocess.run([importer, folder / "run.h5"], capture_output=True, check=False)
    assert ended.returncode == 1
    assert b"dataset.json" in ended.stderr and b"Traceback" not in ended.stderr


def test_the_end_of_a_large_dataset_is_left_out(folder, tmp_path, read, monkeypatch, capfd):
    monkeypatch.setattr(drawing, "LIMIT_BYTES", 3000)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "out.rrd")
    drawing.write_dataset(folder, stream)
    stream.disconnect()
    rows = read(tmp_path / "out.rrd", "/training/env_1/energy", "Scalars:scalars", "row")
    shown = int(capfd.readouterr().err.partition("first ")[2].partition(" of 12")[0])
    assert [row for row, _ in rows] == list(range(0, shown, 2)) and 0 < shown < ROWS


def test_rerun_itself_reads_a_single_file_and_a_partition(folder, tmp_path):
    single, partition = tmp_path / "single.h5", folder / "run_training_cloud_0.h5"
    assert physx(["export", str(folder), str(single), "--to", "hdf5-single"]) == 0
    chunks = Hdf5Reader(single).stream(root_group="training")
    (rows,) = (c for c in chunks if c.entity_path == "/")
    (columns,) = rows.to_record_batch()["data"].to_pylist()[:1]
    assert {"cloud", "force", "energy", "heat"} <= columns[0].keys()
    ignored = ["/commits", "/digests", "/header", "/rows"]
    chunks = Hdf5Reader(partition).stream(ignore_datasets=ignored)
    (rows,) = (c for c in chunks if c.entity_path == "/")
    assert rows.to_record_batch().num_rows == ROWS


def test_each_row_of_free_axes_has_its_own_mesh(tmp_path, read):
    square = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    cells = [np.array([[0, 1, 2]]), np.array([[0, 1, 2], [1, 3, 2]])]
    fields = [
        Field("place", ("node", 2), unit="m"),
        Field("triangle", ("triangle", 3), "int64", indexes="node"),
        Field("heat", ("node",), unit="K"),
        Field("strain", ("triangle", 2)),
        Field("signal", ("time",)),
    ]
    with Dataset.create(tmp_path / "dataset") as dataset:
        dataset.define_fields("training", fields)
        rows = {
            "place": [square[:3], square],
            "triangle": cells,
            "heat": [np.arange(3.0), np.arange(4.0)],
            "strain": [np.ones((1, 2)), np.array([[1.0, 2.0], [3.0, 4.0]])],
            "signal": [np.zeros(2), np.zeros(3)],
        }
        dataset.append("training", rows)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "out.rrd")
    drawing.write_dataset(tmp_path / "dataset", stream)
    stream.disconnect()

    def drawn(name, component):
        found = read(tmp_path / "out.rrd", f"/training/env_1/{name}", component, "row")
        return [(row, np.array(value)) for row, value in found if row is not None]

    for (row, points), (_, triangles) in zip(
        drawn("heat", "Mesh3D:vertex_positions"),
        drawn("heat", "Mesh3D:triangle_indices"),
        strict=True,
    ):
        np.testing.assert_array_equal(points.reshape(-1, 3)[:, :2], rows["place"][row])
        np.testing.assert_array_equal(triangles.reshape(-1, 3), cells[row])
    colors = [set(value.tolist()) for _, value in drawn("heat", "Mesh3D:vertex_colors")]
    assert len(colors[0]) == 3 and len(colors[1]) == 4 and colors[0] < colors[1]
    for name in ("strain_0", "strain_1"):  # each triangle has one color
        shades = dict(drawn(name, "Mesh3D:vertex_colors"))[1].reshape(2, 3)
        assert (shades == shades[:, :1]).all() and shades[0, 0] != shades[1, 0]


@pytest.mark.parametrize("width", [2, 4])
def test_meshes_of_episodes_are_drawn_with_their_rows(width, tmp_path, read):
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3), [[1.0, 1.0, 1.0]]])
    cells = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])[:, :width]

    class Solid(Environment):
        independent_episodes, episode_steps = True, 2

        def create(self):
            pass

        def init_database(self):
            self.define_training_fields([Field("heat", ("node",))])
            cell = Field("cell", ("cell", width), "int64", indexes="node")
            self.define_episode_fields([Field("place", ("node", 3)), cell])

        def reset_parameters(self):
            self.size = 1.0 + self.episode_index
            self.set_episode_data(place=self.size * corners, cell=cells)

        def step(self):
            self.set_training_data(heat=np.arange(5.0))

    config = EnvironmentConfig(Solid, as_tcp_ip_client=False, seed=1)
    DataGeneration(config, episodes=2, session_dir=str(tmp_path), quiet=True).execute()
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "out.rrd")
    drawing.write_dataset(tmp_path / "data_generation", stream)
    stream.disconnect()
    shown = "Mesh3D:vertex_positions" if width == 4 else "Points3D:positions"
    found = read(tmp_path / "out.rrd", "/training/env_0/heat", shown, "row")
    for row, points in found:
        scale = 1.0 + row // 2
        np.testing.assert_array_equal(np.reshape(points, (-1, 3)), scale * corners)
    assert [row for row, _ in found] == [0, 1, 2, 3]
    component = "Mesh3D:triangle_indices" if width == 4 else "LineStrips3D:strips"
    (_, parts), *_ = read(tmp_path / "out.rrd", "/training/env_0/heat", component, "row")
    assert len(np.reshape(parts, (-1, 3))) == (6 if width == 4 else 4)  # without the side inside
