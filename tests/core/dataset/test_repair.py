"""Repairs that must not lose sound rows."""

import numpy as np

from physx_core import Dataset


def make(folder):
    with Dataset.create(folder, max_file_size=2.4e-5) as dataset:  # a few hundred rows a file
        for start in range(0, 2000, 100):
            x = np.arange(start, start + 100.0)
            dataset.append("training", {"x": x[:, None].repeat(3, 1), "y": x})
        return len(list(folder.glob("*_x_*.h5")))


def test_a_missing_file_costs_its_own_partition_only(tmp_path):
    folder = tmp_path / "data"
    assert make(folder) > 3
    rows = 2000
    lost = folder / "run_training_x_1.h5"
    (folder / "dataset.json").unlink()
    lost.unlink()
    Dataset.repair(folder)
    with Dataset.open(folder) as dataset:
        y = dataset["training"]["y"][:]
        assert dataset.verify() == []
        assert np.array_equal(dataset["training"]["x"][:][:, 2], y)
    missing = np.setdiff1d(np.arange(rows), y)
    assert 0 < len(missing) < rows / 3
    assert np.array_equal(missing, np.arange(missing[0], missing[-1] + 1))


def test_numbers_stand_in_one_line_of_the_manifest(tmp_path):
    make(tmp_path / "data")
    text = (tmp_path / "data/dataset.json").read_text()
    assert '"shape": [3]' in text
