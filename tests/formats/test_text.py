"""Text goes through the formats that hold it; the others name the fields that are text."""

import csv

import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_formats import ExchangeError, ExportOptions, edit, export, import_file
from physx_formats.format import all_formats

TEXTS = ["steel", "", "größe", 'a,"b"', "NA", " 1"]
FIELDS = [Field("label", (), "S9", role="additional"), Field("pair", (2,), "S3"), Field("x", ())]


@pytest.fixture
def stored(tmp_path):
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.define_fields("training", FIELDS)
        pairs = [[text[:2], "ß"] for text in TEXTS]
        dataset.append("training", {"label": TEXTS, "pair": pairs, "x": np.arange(6.0)})
    with Dataset.open(tmp_path / "set") as dataset:
        yield dataset


def rows(folder):
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        mode = dataset["training"]
        return {name: mode[name][:].tolist() for name in mode}, dataset.fields("training")


@pytest.mark.parametrize("to", [name for name, form in all_formats().items() if form.text])
def test_text_comes_back(to, stored, tmp_path):
    export(stored, to, tmp_path / f"out.{to}")
    import_file(tmp_path / f"out.{to}", tmp_path / "copy")
    found, fields = rows(tmp_path / "copy")
    assert found == rows(tmp_path / "set")[0]
    if to != "csv":  # which notes no widths
        assert fields == {field.name: field for field in FIELDS}


@pytest.mark.parametrize(
    "to", [name for name, form in all_formats().items() if form.write and not form.text]
)
def test_other_formats_name_the_fields_that_are_text(to, stored, tmp_path):
    options = ExportOptions(**({"fps": 10} if to == "lerobot" else {}))
    with pytest.raises(ExchangeError, match=f"{to} holds numbers.*label, pair"):
        export(stored, to, tmp_path / "out", options=options)


def test_text_of_somebody_else_is_imported(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = arrow.table({"note": TEXTS, "x": np.arange(6.0)})
    parquet.write_table(table, tmp_path / "a.parquet")
    with (tmp_path / "a.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("note", "x"), *zip(TEXTS[:4], range(4), strict=True)])
    for name, count in (("a.parquet", 6), ("a.csv", 4)):
        import_file(tmp_path / name, tmp_path / f"{name} set")
        found, fields = rows(tmp_path / f"{name} set")
        assert found["note"] == [text.encode() for text in TEXTS[:count]]
        assert fields["note"] == Field("note", (), "S7", role="additional")


def test_text_is_edited(stored, tmp_path):
    edit(
        tmp_path / "set", tmp_path / "new", cast={"label": "S20"}, rename={"pair": "two"},
        rows=lambda rows: rows["label"] != b"steel",
        derive=lambda rows: {"kind": np.where(rows["x"] > 2, b"late", b"early")},
    )  # fmt: skip
    found, fields = rows(tmp_path / "new")
    assert found["label"] == [text.encode() for text in TEXTS[1:]]
    assert found["kind"] == [b"early"] * 2 + [b"late"] * 3
    assert fields["label"].dtype == "|S20" and fields["two"].dtype == "|S3"
    with pytest.raises(ExchangeError, match=r'"S16"'):
        edit(tmp_path / "set", tmp_path / "no", derive=lambda rows: {"k": np.full(6, "a")})
