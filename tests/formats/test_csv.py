"""CSV files keep values, names, arrays and units, and say what they cannot hold."""

import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_core.errors import ConfigError
from physx_formats import ExchangeError, ExportOptions, export, import_file

pytest.importorskip("pyarrow")
RNG = np.random.default_rng(0)


def store(path, fields, rows):
    with Dataset.create(path) as dataset:
        dataset.define_fields("training", fields)
        dataset.append("training", rows)
    return path


@pytest.mark.parametrize("kind", ["f8", "f4", "f2", "i4", "u1", "?"])
def test_values_come_back_exactly(kind, tmp_path):
    rows = (RNG.normal(size=(30, 2, 3)) * 10 ** RNG.uniform(-3, 3, (30, 2, 3))).astype(kind)
    if kind == "u1":
        rows = RNG.integers(0, 256, (30, 2, 3), np.uint8)
    scalars = np.arange(30, dtype=np.int64)
    fields = [Field("x", (2, 3), kind, "m"), Field("n", (), np.int64)]
    store(tmp_path / "set", fields, {"x": rows, "n": scalars})
    with Dataset.open(tmp_path / "set") as dataset:
        assert export(dataset, "csv", tmp_path / "out.csv") == {"training": 30}
    assert import_file(tmp_path / "out.csv", tmp_path / "copy") == {"training": 30}
    with Dataset.open(tmp_path / "copy") as dataset:
        found = dataset["training"]
        assert np.array_equal(found["x"][:], rows) and np.array_equal(found["n"][:], scalars)
        assert (dataset.fields("training")["x"].unit, found["x"].shape) == ("m", (30, 2, 3))


def test_components_of_several_units_have_their_own(tmp_path):
    store(tmp_path / "set", [Field("q", (2,), unit="rad, rad/s")], {"q": np.ones((2, 2))})
    with Dataset.open(tmp_path / "set") as dataset:
        export(dataset, "csv", tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == '"q[0] [rad]","q[1] [rad/s]"'
    import_file(tmp_path / "out.csv", tmp_path / "copy")
    with Dataset.open(tmp_path / "copy") as dataset:
        assert dataset.fields("training")["q"].unit == "rad, rad/s"


def test_a_table_of_somebody_else_is_imported(tmp_path):
    text = "time [s],force (x),count,ok,note\n0.5,1e-3,1,true,a\n1.0,-2,2,false,\n"
    (tmp_path / "log.csv").write_text(text)
    import_file(tmp_path / "log.csv", tmp_path / "set")
    with Dataset.open(tmp_path / "set") as dataset:
        rows = {name: dataset["training"][name][:].tolist() for name in dataset.fields("training")}
    assert rows == {
        "time": [0.5, 1.0], "force__x_": [1e-3, -2.0], "count": [1, 2], "ok": [True, False],
        "note": [b"a", b""],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "wanted"),
    [
        (["2020-01-31", "2021-01-31"], [b"2020-01-31", b"2021-01-31"]),
        (["10:00:00", "11:30:00"], [b"10:00:00", b"11:30:00"]),
        (["2020-01-31T10:00:00Z", "2021-01-31T10:00:00Z"], [b"2020-01-31T10:00:00Z", ...]),
        (["18446744073709551615", "9007199254740993"], [2**64 - 1, 2**53 + 1]),
        (["1e20", "2.5"], [1e20, 2.5]),
    ],
)
def test_what_is_no_common_number_is_imported_as_it_is(texts, wanted, tmp_path):
    (tmp_path / "log.csv").write_text("\n".join(["x,y", *(f"{text},1e19" for text in texts)]))
    import_file(tmp_path / "log.csv", tmp_path / "set")
    with Dataset.open(tmp_path / "set") as dataset:
        found = dataset["training"]["x"][:].tolist()
        assert dataset["training"]["y"][:].tolist() == [1e19, 1e19]
    assert [one for one, other in zip(found, wanted, strict=True) if other not in (one, ...)] == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a,b\n1,2\n3\n", "not a valid CSV file"),
        ("a\n1\n\n3\n", None),
        ("a,b\n1,\n2,3\n", '"b" of .* has no number in row 0'),
        ("a,b\n1,\n2,\n", '"b" of .* has no number in row 0'),
        ("a,a\n1,2\n", "several columns for the same place"),
        ("a,a[0]\n1,2\n", "several columns for the same place"),
        ("a[0],a[2]\n1,2\n", r"leave out places of \(3,\)"),
        ("", "not a valid CSV file"),
    ],
)
def test_files_that_are_no_tables_are_refused(text, reason, tmp_path):
    (tmp_path / "bad.csv").write_text(text)
    if reason is None:  # empty lines are none
        assert import_file(tmp_path / "bad.csv", tmp_path / "set") == {"training": 2}
        return
    with pytest.raises(ExchangeError, match=reason):
        import_file(tmp_path / "bad.csv", tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_what_a_table_cannot_hold_is_named(tmp_path):
    store(tmp_path / "set", [Field("z", (), np.complex64)], {"z": np.ones(2, np.complex64)})
    store(tmp_path / "wide", [Field("u", (200, 200))], {"u": np.ones((1, 200, 200))})
    with Dataset.open(tmp_path / "set") as dataset:
        with pytest.raises(ExchangeError, match='CSV has no equivalent of complex64.*"z"'):
            export(dataset, "csv", tmp_path / "out.csv")
        with pytest.raises(ConfigError, match="points is for vtkhdf, not for csv"):
            export(dataset, "csv", tmp_path / "out.csv", options=ExportOptions(points="z"))
    wide = pytest.raises(ExchangeError, match="40,000 columns")
    with Dataset.open(tmp_path / "wide") as dataset, wide:
        export(dataset, "csv", tmp_path / "out.csv")
    assert not list(tmp_path.glob("*.csv"))
