"""Independent episodes in other formats: rows, records and parameters there and back."""

import h5py
import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus
from physx_formats import ExchangeError, export, import_file
from physx_formats.transfer import episodes

pytestmark = pytest.mark.processes
MESH = Field("mesh", (2,), "f4", "m", role="episode")


def store(dataset, mode, episode, values, **options):
    parameters = {"mass": 0.1 * episode, "at": np.array([episode, -1.0], "f4")}
    has_ended = options.get("status") not in (EpisodeStatus.FAILED, EpisodeStatus.MORE)
    fields = {"mesh": [episode, 0.5]} if has_ended else {}
    record = EpisodeRecord(
        episode=episode, rows=len(values), parameters=parameters, fields=fields, seconds=0.3,
        **options,
    )  # fmt: skip
    rows = {"x": np.array(values, float)}
    dataset.append_episodes(mode, rows, [record], episode_fields=[MESH])


@pytest.fixture
def dataset(tmp_path):
    with Dataset.create(tmp_path / "data") as made:
        made.append("training", {"x": [-2.0, -1.0]})
        for episode in (3, 1, 0):
            store(made, "training", episode, 100.0 * episode + np.arange(10 + episode))
        store(made, "training", 2, [200.0], status=EpisodeStatus.MORE)
        store(made, "training", 4, [], status=EpisodeStatus.FAILED)
        store(made, "training", 2, [201.0], part=1, status=EpisodeStatus.CUT)
        store(made, "training", 5, [1.0], status=EpisodeStatus.MORE)  # it never ends
        store(made, "training", 0, [7.0], campaign=2)
        made.append("training", {"x": [9.0]})
        store(made, "validation", 0, [5.0, 6.0])
        yield made


def look(dataset, modes=("training", "validation")):
    """Return rows, episodes, parameters and costs."""
    table = dataset.episode_table(modes)
    kept = table["rows"] + (table["status"] != EpisodeStatus.STREAM) > 0  # no stream without rows
    table = {name: column[kept] for name, column in table.items()}
    fields = dict(dataset.fields(EPISODES))
    assert fields["mesh"] == MESH
    rows = [dataset[mode]["x"][:].tobytes() for mode in modes]
    stream = table["status"] == EpisodeStatus.STREAM
    for name in ("campaign", *(table.keys() - {"mode_index", "rows", "first_row", "status"})):
        table[name][stream] = 0
    return rows, fields, {name: column.tobytes() for name, column in table.items()}


@pytest.mark.parametrize("to", ["hdf5-single", "npz"])
@pytest.mark.parametrize("block", [None, 24])
def test_episodes_come_back_bit_for_bit(dataset, tmp_path, to, block, monkeypatch):
    if block:
        monkeypatch.setattr(episodes, "BLOCK", block)
    written = export(dataset, to, tmp_path / "out")
    assert written["training"] == len(dataset["training"]["x"])
    assert written.pop(EPISODES) == len(dataset.episode_table(["training", "validation"])["rows"])
    assert import_file(tmp_path / "out", tmp_path / "copy") == written
    with Dataset.open(tmp_path / "copy") as found:
        assert look(found) == look(dataset)
        assert found.verify() == []


def test_ranges_of_episodes_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(episodes, "BLOCK", 24)
    with Dataset.create(tmp_path / "data") as dataset:
        for first in (8, 0):
            record = EpisodeRecord(episode=first, rows=8, count=8)
            rows = {"x": np.arange(first, first + 8.0)}
            dataset.append_episodes("training", rows, [record])
        export(dataset, "hdf5-single", tmp_path / "out")
    import_file(tmp_path / "out", tmp_path / "copy")
    with Dataset.open(tmp_path / "copy") as found:
        assert found["training"]["x"][:].tolist() == list(range(16))
        assert [e.episode for e in found.episodes("training")] == list(range(16))


def test_imported_campaigns_come_after_those_that_are_there(dataset, tmp_path):
    export(dataset, "hdf5-single", tmp_path / "out")
    rows = dataset["training"]["x"][:].tolist()
    import_file(tmp_path / "out", tmp_path / "copy")
    import_file(tmp_path / "out", tmp_path / "copy")
    with Dataset.open(tmp_path / "copy") as found:
        assert found["training"]["x"][:].tolist() == [*rows, *rows]
        assert len(found.failed_episodes("training")) == 2


def test_groups_of_other_formats_hold_the_episodes(dataset, tmp_path):
    export(dataset, "hdf5-single", tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5") as file:
        table = file[EPISODES]
        where = (table["episode"][:] == 3) & (table["mode_index"][:] == 0)
        (first,), (rows,) = table["first_row"][where], table["rows"][where]
        assert file["training/x"][first : first + rows].tolist() == list(range(300, 313))
        assert table["mass"][where].tolist() == [0.1 * 3]


def test_one_mode_alone_has_no_records(dataset, tmp_path):
    export(dataset, "npz", tmp_path / "out.npz", modes=["training"])
    assert np.load(tmp_path / "out.npz").files == ["x"]
    import_file(tmp_path / "out.npz", tmp_path / "copy")
    with Dataset.open(tmp_path / "copy") as found:
        assert found.modes == ["training"]


def test_records_that_do_not_fit_their_rows_are_refused(dataset, tmp_path):
    export(dataset, "hdf5-single", tmp_path / "out")
    with h5py.File(tmp_path / "out", "r+") as file:
        file[EPISODES]["rows"][3] += 1
    with pytest.raises(ExchangeError, match="do not fit"):
        import_file(tmp_path / "out", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
