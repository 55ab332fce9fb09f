"""Robots are pulled at while they run, and simulated again with the same bits."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig, Visualizer
from physx_core.pipelines import Branch

pytestmark = pytest.mark.processes


class Person(Visualizer):
    """Pulls at a leg for a while, and changes gravity."""

    asked = 0

    def touch(self, instance_id):
        self.asked += 1
        pull = [0, 3, 0.0, 40.0, 60.0] if self.asked % 20 < 8 else [-1, 0, 0, 0, 0]
        return [0.0, 0.0, -9.81 if self.asked < 15 else -4.0, *pull]


@pytest.mark.parametrize("backend", ["dart", "mujoco"])
def test_a_robot_that_was_pulled_at_is_simulated_again(backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if backend == "mujoco":
        pytest.importorskip("physx_mujoco")
    paths = []
    for visualizer in (None, Person):
        config = EnvironmentConfig(
            "gym/physx/Ant-v0",
            {"backend": backend},
            as_tcp_ip_client=False,
            seed=3,
            visualizer=visualizer,
        )
        run = DataGeneration(config, batch_nb=1, batch_size=60, quiet=True)
        run.execute()
        paths.append(run.session.path)
    rows = []
    for path in paths:
        with Dataset.open(path) as dataset:
            rows.append(np.array(dataset["training"]["next_observation"][:60]))
    assert not np.allclose(rows[0][5], rows[1][5])
    with Dataset.open(paths[1]) as dataset:
        row = int(np.asarray(dataset["training"]["terminated"][:60]).argmax() or 40) - 4
    branch = Branch(paths[1], row, {"gravity": [0, 0, -1]}, step_nb=4, quiet=True)
    branch.execute()
    assert branch.rows_equal[1] == 4
