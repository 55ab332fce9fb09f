"""DeepPhysX datasets: SQLite databases with pickled arrays, written as its library does."""

import os
import pickle
import sqlite3

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset
from physx_core.cli import main
from physx_formats import ExchangeError, import_file

RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(12, 5)), RNG.normal(size=(12, 1))
FORCE = np.asfortranarray(RNG.normal(size=(12, 4, 3)).astype("f4"))


def dumps(array):
    """Pickle as `ndarray.dumps` does, which SSD calls."""
    return np.asarray(array).dumps()


def partition(path, training, additional=None, dump=dumps, env_id=True):
    """Write a partition: SSD creates the tables with `id` only, and then adds the columns."""
    database = sqlite3.connect(path)
    for table, fields in (("training", training), ("additional", additional or {})):
        database.execute(
            f'CREATE TABLE IF NOT EXISTS "{table}" ("id" INTEGER NOT NULL PRIMARY KEY)'
        )
        columns = {"env_id": "INTEGER"} if env_id else {}
        for name, values in fields.items():
            kinds = {int: "INTEGER", float: "REAL", str: "TEXT", bool: "INTEGER"}
            columns[name] = kinds.get(type(values[0]), "NUMPY")
        for name, kind in columns.items():
            database.execute(f'ALTER TABLE "{table}" ADD COLUMN "{name}" {kind}')
        rows = max((len(values) for values in (*training.values(), *fields.values())), default=0)
        for row in range(rows):
            values = [row % 2 + 1] if env_id else []
            for given in fields.values():
                is_array = isinstance(given[row], np.ndarray)
                values.append(dump(given[row]) if is_array else given[row])
            names = ", ".join(f'"{name}"' for name in columns)
            marks = ", ".join("?" * len(columns))
            database.execute(f'INSERT INTO "{table}" ({names}) VALUES ({marks})', values)
    database.commit()
    database.close()


@pytest.fixture
def session(tmp_path):
    """A session with three partitions of training samples and one of validation samples."""
    folder = tmp_path / "pendulum" / "dataset"
    folder.mkdir(parents=True)
    for index, rows in {10: slice(8, 12), 0: slice(5), 2: slice(5, 8)}.items():
        partition(
            folder / f"pendulum_training_{index}.db",
            {"input": X[rows], "ground_truth": Y[rows]},
            {"force": FORCE[rows], "time": [float(value) for value in range(12)[rows]]},
        )
    partition(folder / "pendulum_validation_0.db", {"input": X[:3], "ground_truth": Y[:3]})
    for name in ("Exchange.db", "Visualization.db"):
        sqlite3.connect(folder / name).execute("CREATE TABLE exchange (id INTEGER)")
    (folder / "dataset.json").write_text('{"partitions": {"training": ["pendulum_training_0"]}}')
    return folder.parent


@pytest.mark.parametrize("place", ["session", "dataset"])
def test_a_dataset_becomes_one_of_physx(session, folder, place, capsys):
    path = session if place == "session" else session / "dataset"
    assert main(["import", str(path), str(folder)]) == 0
    assert "12 training samples" in capsys.readouterr().out
    with Dataset.open(folder) as dataset:
        assert {mode: dataset.num_samples(mode) for mode in dataset.modes} == {
            "training": 12,
            "validation": 3,
        }
        assert_array_equal(dataset["training"]["input"][:], X)
        assert_array_equal(dataset["training"]["ground_truth"][:], Y)
        assert_array_equal(dataset["training"]["force"][:], FORCE)
        assert dataset["training"]["force"].dtype == np.float32
        assert_array_equal(dataset["training"]["time"][:], np.arange(12.0))
        assert_array_equal(dataset["training"]["env_id"][:5], [1, 2, 1, 2, 1])
        roles = {name: field.role for name, field in dataset.fields("training").items()}
        assert roles["input"] == roles["ground_truth"] == "training"
        assert roles["force"] == roles["time"] == roles["env_id"] == "additional"
        assert_array_equal(dataset["validation"]["input"][:], X[:3])
        assert dataset.verify() == []


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_pickle_of_numpy_is_read(tmp_path, folder, protocol):
    """Of NumPy 1, too, whose pickles name another module."""
    arrays = {
        "a": X[:6],
        "empty": np.zeros((6, 0)),
        "flag": X[:6] > 0,
        "big": X[:6].astype(">f4"),
        "whole": np.arange(18, dtype="u2").reshape(6, 3),
        "turned": FORCE[:6].transpose(0, 2, 1),
        "complex": X[:6] + 1j,
    }

    def dump(array):
        return pickle.dumps(array, protocol).replace(b"numpy._core", b"numpy.core")

    partition(tmp_path / "a_training_0.db", arrays, dump=dump if protocol < 4 else pickle.dumps)
    assert import_file(tmp_path / "a_training_0.db", folder) == {"training": 6}
    with Dataset.open(folder) as dataset:
        for name, values in arrays.items():
            assert_array_equal(dataset["training"][name][:], values)


def test_one_database_of_the_last_version_is_read(tmp_path, folder):
    database = sqlite3.connect(tmp_path / "dataset.db")
    for table, rows in {"train": 4, "test": 2, "run": 0}.items():
        database.execute(f"CREATE TABLE {table} (id INTEGER NOT NULL PRIMARY KEY, x NUMPY)")
        for row in range(rows):
            database.execute(f"INSERT INTO {table} (x) VALUES (?)", [dumps(X[row])])
    database.commit()
    database.close()
    assert import_file(tmp_path, folder) == {"training": 4, "validation": 2}
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["validation"]["x"][:], X[:2])


def test_files_of_the_first_version_are_read(tmp_path, folder):
    old = tmp_path / "old" / "dataset"
    old.mkdir(parents=True)
    for index, rows in enumerate((slice(7), slice(7, 12))):
        np.save(old / f"training_training_IN_{index}.npy", X[rows])
        np.save(old / f"training_training_OUT_{index}.npy", np.asfortranarray(Y[rows]))
        np.save(old / f"training_training_ADD_force_{index}.npy", FORCE[rows])
    assert import_file(tmp_path / "old", folder) == {"training": 12}
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["input"][:], X)
        assert_array_equal(dataset["training"]["ground_truth"][:], Y)
        assert_array_equal(dataset["training"]["force"][:], FORCE)
        assert dataset.fields("training")["force"].role == "additional"


@pytest.mark.slow
def test_rows_that_are_no_samples_are_named(tmp_path, folder):
    cases = {
        "missing": ([X[0], None, X[2]], "Row 1 .* has no value"),
        "shape": ([X[0], X[1, :3], X[2]], r"Row 1 has the shape \(3,\)"),
        "type": ([X[0].astype("f4"), X[1], X[2]], "type float64, unlike the first"),
        "text": (["a", "b", "c"], "<U1"),
        "never": ([None, None, None], "Row 0 .* has no value"),
    }
    for name, (values, message) in cases.items():
        path = tmp_path / f"{name}_training_0.db"
        partition(path, {"good": X[:3], name: values})
        with pytest.raises(ExchangeError, match=message):
            import_file(path, folder)
        assert not folder.exists()
        chosen = import_file(path, tmp_path / name, fields=["training/good"])
        assert chosen == {"training": 3}


# From strangers ---------------------------------------------------------------------------------


class Bomb:
    def __init__(self, call=os.mkdir, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def hostile_pickles(target):
    array = pickle.dumps(X[0], 2)
    objects = np.array([Bomb(os.mkdir, target)], object)
    return {
        "a call": pickle.dumps(Bomb(os.mkdir, target)),
        "a call, protocol 0": pickle.dumps(Bomb(os.mkdir, target), 0),
        "an array of objects": objects.dumps(),
        "an object behind an array": array[:-1] + pickle.dumps(Bomb(os.mkdir, target), 2)[2:],
        "builtins": b"cbuiltins\neval\n(X\x05\x00\x00\x001 + 1tR.",
        "bytes of a number": b"\x80\x02c__builtin__\nbytes\nJ\xff\xff\xff\x7f\x85R.",
        "numpy.load": b"\x80\x02cnumpy\nload\nX\x01\x00\x00\x00a\x85R.",
        "a path within numpy": b"\x80\x04\x8c\x05numpy\x8c\x09os.system\x93\x8c\x01a\x85R.",
        "an extension": b"\x80\x02\x82\x01.",
        "a persistent object": b"\x80\x02X\x01\x00\x00\x00aQ.",
        "a deep tuple as a key": b"\x80\x02}" + b")" + b"\x85" * 10**6 + b"Ns.",
        "many lists": b"\x80\x02" + b"]" * 10**6 + b".",
        "another length": array.replace(b"K\x05\x85", b"K\x06\x85"),
        "a huge shape": array.replace(b"K\x05\x85", b"J\xff\xff\xff\x7f\x85"),
        "a negative shape": array.replace(b"K\x05\x85", b"J\xff\xff\xff\xff\x85"),
        "objects instead of bytes": array.replace(b"X\x02\x00\x00\x00f8", b"X\x02\x00\x00\x00O8"),
        "records": np.zeros(2, "f8,f8").dumps(),
        "dates": np.zeros(2, "M8[s]").dumps(),
        "half of one": array[: len(array) // 2],
        "nothing": b"",
        "a dictionary": pickle.dumps({"x": 1.0}),
    }


@pytest.mark.parametrize("kind", hostile_pickles(""))
def test_a_pickle_of_anything_but_an_array_is_rejected(tmp_path, folder, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = hostile_pickles(str(tmp_path / "executed"))[kind]
    partition(tmp_path / "a_training_0.db", {"x": [X[0], X[1]]})
    with sqlite3.connect(tmp_path / "a_training_0.db") as database:
        database.execute("UPDATE training SET x = ? WHERE id = 2", [content])
    database.close()
    with pytest.raises(ExchangeError, match="Row 1 .* is not an array of numbers"):
        import_file(tmp_path / "a_training_0.db", folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_training_0.db"]


def test_a_schema_can_do_nothing(tmp_path, folder):
    schemas = {
        "view": "CREATE VIEW training AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 "
        "FROM n) SELECT i AS x FROM n",
        "computed": "CREATE TABLE training (id INTEGER PRIMARY KEY, x AS (zeroblob(1000000000)))",
        "other": "CREATE TABLE secrets (id INTEGER PRIMARY KEY, x)",
    }
    for name, text in schemas.items():
        path = tmp_path / f"{name}_training_0.db"
        with sqlite3.connect(path) as database:
            database.execute(text)
            if name == "computed":
                database.execute("INSERT INTO training (id) VALUES (1)")
        database.close()
        with pytest.raises(ExchangeError, match="none of DeepPhysX's tables|is computed"):
            import_file(path, folder)


def test_links_and_damaged_databases_are_rejected(tmp_path, folder):
    (tmp_path / "elsewhere").mkdir()
    partition(tmp_path / "elsewhere" / "secret.db", {"x": X})
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "a_training_0.db").symlink_to(tmp_path / "elsewhere" / "secret.db")
    (tmp_path / "pipes").mkdir()
    os.mkfifo(tmp_path / "pipes" / "a_training_IN_0.npy")
    for name in ("links", "pipes"):
        with pytest.raises(ExchangeError, match="not a regular file"):
            import_file(tmp_path / name, folder)
    content = bytearray((tmp_path / "elsewhere" / "secret.db").read_bytes())
    content[5000:] = bytes(len(content) - 5000)
    (tmp_path / "b_training_0.db").write_bytes(content)
    with pytest.raises(ExchangeError, match=r"b_training_0\.db"):
        import_file(tmp_path / "b_training_0.db", folder)
    with pytest.raises(ExchangeError, match="is of no known format"):
        import_file(tmp_path / "elsewhere", folder)
    assert not folder.exists()
