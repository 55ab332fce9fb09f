"""What is exported comes back equal from each format, but for what the format says it loses."""

from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_formats import ExchangeError, import_file
from physx_formats.cli.export import run
from physx_formats.format import LOSSES, all_formats

README = Path(__file__).parents[2] / "physx_formats" / "README.md"
WRITTEN = {name: form for name, form in all_formats().items() if form.write}
FIELDS = [
    Field("state", (2,), "float32", "m, m/s"),
    Field("next", (2,), "float32", "m, m/s", like="state"),
    Field("image", (3, 2), "uint8", axes=("y", "x"), role="additional"),
    Field("count", (), "int16"),
    Field("hit", (), "bool"),
    Field("points", (3, 2), unit="m"),
    Field("step", (), role="additional"),
    Field("episode", (), "int64", role="additional"),
    Field("label", (), "S8", role="additional"),
    Field("camera", (6, 5, 3), "uint8", axes=("y", "x", "color")),
]
LENGTHS = (3, 0, 4)
NEEDED = {"lerobot": {"fps": 10}, "vtkhdf": {"points": "points"}}
LIBRARIES = {
    "parquet": ["pyarrow"], "csv": ["pyarrow"], "safetensors": ["safetensors"], "zarr": ["zarr"],
    "minari": ["minari"], "lerobot": ["pyarrow", "pandas", "av"],
}  # fmt: skip


def store(folder, *, text):
    count = sum(LENGTHS)
    chance = np.random.default_rng(0)
    fields = [field for field in FIELDS if text or not field.is_text]
    rows = {
        "state": chance.normal(size=(count, 2)).astype("f4"),
        "next": chance.normal(size=(count, 2)).astype("f4"),
        "image": chance.integers(0, 256, (count, 3, 2), np.uint8),
        "count": np.arange(count, dtype="i2") - 3, "hit": np.arange(count) % 3 == 0,
        "points": chance.normal(size=(count, 3, 2)),
        "step": np.concatenate([np.arange(n, dtype=float) for n in LENGTHS]),
        "episode": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        "label": ["größe"[: n % 6] for n in range(count)],
        "camera": np.add.outer(9 * np.arange(count), np.arange(90).reshape(6, 5, 3)).astype("u1"),
    }  # fmt: skip
    records = [
        EpisodeRecord(episode=n, rows=length, parameters={"mass": n + 0.5},
            status=EpisodeStatus.FINISHED if length else EpisodeStatus.FAILED)
        for n, length in enumerate(LENGTHS)
    ]  # fmt: skip
    with Dataset.create(folder) as dataset:
        dataset.define_fields("training", fields)
        given = {field.name: rows[field.name] for field in fields}
        dataset.append_episodes("training", given, records)


def contents(folder):
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        rows = {name: dataset["training"][name][:].tolist() for name in dataset["training"]}
        table = dataset.episode_table(["training"]) if dataset.has_episodes else None
        return rows, dataset.fields("training"), table


@pytest.mark.parametrize("to", WRITTEN)
def test_rows_fields_and_episodes_come_back_or_the_loss_is_named(to, tmp_path, capsys):
    form, out = WRITTEN[to], tmp_path / f"out.{to}"
    for library in LIBRARIES.get(to, ()):
        pytest.importorskip(library)
    store(tmp_path / "data", text=form.text)
    words = [f"--{name}={value}" for name, value in NEEDED.get(to, {}).items()]
    run([str(tmp_path / "data"), str(out), "--to", to, *words])
    said = capsys.readouterr().out
    assert [name for name in LOSSES if LOSSES[name] in said] == [
        n for n in LOSSES if n in form.loses
    ]
    if "way back" in form.loses:
        with pytest.raises(ExchangeError):
            import_file(out, tmp_path / "copy")
        return
    import_file(out, tmp_path / "copy")
    rows, fields, table = contents(tmp_path / "data")
    found, described, records = contents(tmp_path / "copy")
    if "colors" in form.loses:
        assert np.abs(np.subtract(found.pop("camera"), rows.pop("camera"))).max() < 16
    assert found == rows
    assert {n: of.unit for n, of in described.items()} == {n: of.unit for n, of in fields.items()}
    if "types" not in form.loses:
        assert {n: of.dtype for n, of in described.items()} == {
            n: f.dtype for n, f in fields.items()
        }
    assert (described == fields) == ("notes" not in form.loses)
    assert (records is None) == ("records" in form.loses)
    for name, column in (table if records is not None else {}).items():
        if name != "campaign":
            np.testing.assert_array_equal(records[name], column, err_msg=name)


def test_the_readme_says_what_each_format_loses():
    rows = [line.strip("| ").split("|") for line in README.read_text().splitlines() if "|" in line]
    told = {
        row[0].strip(" `"): [*filter(None, row[3].strip().split(", "))]
        for row in rows
        if len(row) > 3
    }
    for name, form in WRITTEN.items():
        assert told.get(name, []) == list(form.loses), name
