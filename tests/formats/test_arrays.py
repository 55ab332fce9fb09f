"""safetensors and Parquet files come back as they were written, and foreign ones are imported."""

import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_formats import ExchangeError, export, import_file

RNG = np.random.default_rng(0)
KINDS = ["f8", "f4", "f2", "i8", "i2", "u4", "u1", "?", "c8"]


@pytest.fixture(params=["safetensors", "parquet"])
def form(request):
    if request.param == "parquet":
        pytest.importorskip("pyarrow")
    return request.param


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_values_types_units_and_axes_come_back(form, kind, shape, tmp_path):
    rows = (20 * RNG.normal(size=(50, *shape))).astype(np.int8).astype(kind)
    axes = (("y", "x"), ("x",), ())[2 - len(shape)] if shape else ()
    fields = [Field("u", shape, kind, "m", axes=axes), Field("v", shape, kind, like="u", unit="m")]
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.define_fields("training", fields)
        dataset.append("training", {"u": rows, "v": rows[::-1]})
        export(dataset, form, tmp_path / "out")
    assert import_file(tmp_path / "out", tmp_path / "copy") == {"training": 50}
    with Dataset.open(tmp_path / "copy") as dataset:
        found = dataset["training"]
        assert np.array_equal(found["u"][:], rows) and np.array_equal(found["v"][:], rows[::-1])
        assert list(dataset.fields("training").values()) == fields


def test_the_library_reads_a_safetensors_file_and_physx_reads_the_library_s(tmp_path):
    from safetensors.numpy import load_file, save_file

    x = RNG.normal(size=(20, 3))
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.append("training", {"x": x})
        dataset.append("validation", {"x": x[:5]})
        export(dataset, "safetensors", tmp_path / "out.safetensors")
    found = load_file(tmp_path / "out.safetensors")
    assert {name: len(each) for name, each in found.items()} == {
        "training/x": 20,
        "validation/x": 5,
    }
    assert np.array_equal(found["training/x"], x)
    save_file({"a": x, "b": np.arange(20)}, tmp_path / "other")
    assert import_file(tmp_path / "other", tmp_path / "copy") == {"training": 20}
    with Dataset.open(tmp_path / "copy") as dataset:
        assert np.array_equal(dataset["training"]["a"][:], x)


def test_a_safetensors_file_cannot_hold_double_complex_numbers(tmp_path):
    with Dataset.create(tmp_path / "set") as dataset:
        dataset.append("training", {"z": np.ones(3, np.complex128)})
        with pytest.raises(ExchangeError, match='no equivalent of complex128.*"z"'):
            export(dataset, "safetensors", tmp_path / "out")


def test_a_parquet_file_of_somebody_else_is_imported(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = {
        "state": arrow.array([[1.0, 2.0], [3.0, 4.0]], arrow.list_(arrow.float32(), 2)),
        "count": arrow.array([1, 2]),
        "day": arrow.array([1, 2], arrow.date32()),
        "path": arrow.array([[1], [2, 3]]),
        "gap": arrow.array([1, None]),
    }
    parquet.write_table(arrow.table(table), tmp_path / "table.parquet")
    for name, reason in {
        "path": "lists of different lengths", "gap": "without a value", "day": "holds date32"
    }.items():  # fmt: skip
        with pytest.raises(ExchangeError, match=f'"{name}" of .*{reason}'):
            import_file(tmp_path / "table.parquet", tmp_path / "set", fields=[name])
    import_file(tmp_path / "table.parquet", tmp_path / "set", fields=["state", "count"])
    with Dataset.open(tmp_path / "set") as dataset:
        assert dataset["training"]["state"][:].tolist() == [[1, 2], [3, 4]]
        assert dataset.fields("training")["state"].numpy_dtype == np.float32
