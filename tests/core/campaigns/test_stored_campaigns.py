"""What a stored campaign gives to its readers: parameters for replays, rows for other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.workers.instance import PARAMETER, SET
from physx_formats import export, import_file

ENVS = Path(__file__).parents[1] / "programs" / "episode_envs.py"


@pytest.fixture
def generate(tmp_path):
    def run(environment, episodes, **options):
        config = EnvironmentConfig(f"{ENVS}:{environment}", as_tcp_ip_client=False, seed=3)
        names = {"session_dir": str(tmp_path), "session_name": "run", "quiet": True}
        generation = DataGeneration(config, episodes=episodes, **names, **options)
        generation.execute()
        return generation.session.dataset_dir

    return run


def test_replayed_rows_come_with_the_parameters_of_their_episode(generate):
    with Dataset.open(generate("Single", 30)) as dataset:
        index, rows = StoredRows(dataset, "training").take(30)
        assert index.tolist() == list(range(30))
        assert rows[PARAMETER + "p"].tolist() == rows["p"].tolist()
        assert (rows[SET] >= 0).all()


def test_rows_of_a_second_campaign_have_its_own_parameters(generate):
    generate("Single", 5)
    with Dataset.open(generate("Single", 7, new_session=False)) as dataset:
        _, rows = StoredRows(dataset, "training").take(12)
        assert rows[PARAMETER + "p"].tolist() == rows["p"].tolist()
        assert len(set(rows["p"].tolist())) == 12


def test_exported_rows_are_those_that_count_in_their_order(generate, tmp_path):
    place = generate("Single", 20)
    with Dataset.open(place) as dataset:
        written = export(dataset, "npz", tmp_path / "rows.npz")
        assert written == {"training": 20, "episodes": 21}  # with the stream before them
    assert import_file(tmp_path / "rows.npz", tmp_path / "again") == {"training": 20}
    with Dataset.open(place) as before, Dataset.open(tmp_path / "again") as after:
        for name in before.fields("training"):
            assert np.array_equal(before["training"][name][:], after["training"][name][:])
