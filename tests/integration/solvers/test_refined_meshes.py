"""A solver that refines its mesh in each step: killed, resumed, learned from, and seen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)
from physx_core.errors import PhysxError

pytest.importorskip("skfem", reason="scikit-fem is not installed")
EXAMPLES = Path(__file__).parents[3] / "examples"
WELD = f"{EXAMPLES / 'environments' / 'weld.py'}:Weld"
EPISODES = 6
MESH = ("place", "triangle", "edge", "heating", "before", "after")

pytestmark = [
    pytest.mark.processes,
    pytest.mark.slow,
    pytest.mark.usefixtures("nothing_stays_behind"),
]


def physx(*words, cwd):
    return subprocess.Popen([sys.executable, "-m", "physx_core", *map(str, words)], cwd=cwd)


def rows_of(session):
    with Dataset.open(session) as dataset:
        assert dataset.verify() == []
        rows = dataset["training"]
        return {name: list(rows[name]) for name in (*MESH, "episode", "step")}


def recorded(session):
    try:
        with Dataset.open(session) as dataset:
            found = dataset.recorded_episodes("training")
            return 0 if found is None else len(found.episode)
    except PhysxError:  # it has not begun
        return 0


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """A session of two clients that was killed and resumed."""
    folder = tmp_path_factory.mktemp("killed")
    options = ["--environment.sampler", "physx/sobol", "--environment.seed", 1]
    clients = ["--environment.num-clients", 2]
    begun = ["generate", WELD, "--episodes", EPISODES, "--session-name", "weld"]
    run = physx(*begun, *options, *clients, cwd=folder)
    while not recorded(folder / "sessions/weld"):
        assert run.poll() is None
        time.sleep(0.02)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    assert recorded(folder / "sessions/weld") < EPISODES
    assert not physx("generate", "sessions/weld", "--resume", cwd=folder).wait(timeout=120)
    return folder / "sessions/weld"


def test_meshes_of_a_killed_and_resumed_run_are_those_of_one_process(resumed, tmp_path):
    config = EnvironmentConfig(WELD, as_tcp_ip_client=False, sampler="physx/sobol", seed=1)
    generated = DataGeneration(
        config, episodes=EPISODES, session_dir=str(tmp_path), session_name="whole", quiet=True
    )
    generated.execute()
    found, wanted = rows_of(resumed), rows_of(tmp_path / "whole")
    assert len({len(place) for place in wanted["place"]}) > len(wanted["place"]) / 2
    for name, rows in wanted.items():
        assert [each.tobytes() for each in found[name]] == [each.tobytes() for each in rows]


def test_graph_network_learns_from_refined_meshes(resumed, tmp_path):
    pytest.importorskip("torch")
    fields = {"net_fields": ["place", "heating", "before", "edge"], "opt_fields": "after"}
    network = NetworkConfig(
        "torch/graph",
        {"nodes": 4, "outputs": 1, "hidden": 8, "steps": 2, **fields},
        loss="MSELoss", optimizer="Adam", lr=3e-3,
    )  # fmt: skip
    data = DatasetConfig(existing_dir=str(resumed), normalize={"after": "increment"})
    training = Training(
        network, data, epoch_nb=4, batch_size=4, seed=0, session_dir=str(tmp_path), quiet=True
    )
    result = training.execute()
    assert result.values["error/after/relative_l2"] < 0.4


def test_viewer_and_paraview_read_each_refined_mesh(resumed, tmp_path):
    rerun = pytest.importorskip("rerun")
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF", reason="vtk is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    from physx_rerun.recordings import recording_of

    rows = rows_of(resumed)
    with recording_of(resumed) as recording:
        shown = {}
        chunks = rerun.chunk.RrdReader(recording).stream().filter(content="/training/env_0/after")
        for batch in (chunk.to_record_batch() for chunk in chunks):
            if "Mesh3D:vertex_positions" in batch.schema.names:
                names = "row", "Mesh3D:vertex_positions"
                columns = (batch.column(name).to_pylist() for name in names)
                shown.update(zip(*columns, strict=True))
    out = tmp_path / "weld.hdf"
    words = ["--to", "vtkhdf", "--mode", "training", "--points", "place", "--cells", "triangle"]
    assert not physx("export", resumed, out, *words, cwd=tmp_path).wait(timeout=120)
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(out))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == len(rows["place"]) == len(shown)
    for number, place in enumerate(rows["place"]):
        reader.SetStep(number)
        reader.Update()
        grid = reader.GetOutputDataObject(0)
        points = vtk_to_numpy(grid.GetPoints().GetData())
        np.testing.assert_array_equal(points[:, :2], place)
        np.testing.assert_array_equal(np.array(shown[number])[:, :2], place.astype(np.float32))
        cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(-1, 3)
        np.testing.assert_array_equal(cells, rows["triangle"][number])
        after = vtk_to_numpy(grid.GetPointData().GetArray("after"))
        np.testing.assert_array_equal(after, rows["after"][number])
