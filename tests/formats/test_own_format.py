"""Formats that another plugin brings: which of several opens a file, and what the kit finds."""

import pytest

from physx_core import Dataset, Field
from physx_core.errors import ComponentNotFoundError
from physx_formats import ExchangeError, export, import_file
from physx_testing import check_plugin

FORMATS = """
import contextlib
import dataclasses
import numpy as np
from physx_core.plugins import hookimpl
from physx_formats import ArrayColumn, ExchangeError, Format, Notes, encode_notes

def write(tables, path, options):
    (table,) = tables
    values = {name: next(table.column(name))[1] for name in table.fields}
    np.savez(path.open("wb"), notes=encode_notes(tables), **values)
    path.write_bytes(b"OWN" + path.read_bytes())
    return 0

def arrays_of(path):
    copy = path.with_suffix(".copy")
    copy.write_bytes(path.read_bytes()[3:])
    with np.load(copy) as file:
        found = dict(file)
    copy.unlink()
    notes = Notes.parse(str(found.pop("notes")))
    return {name: ArrayColumn(values) for name, values in found.items()}, notes

@contextlib.contextmanager
def read(path, limit):
    try:
        found = arrays_of(path)
    except Exception as error:
        raise ExchangeError(f"{path} is damaged: {error}") from error
    yield found

@contextlib.contextmanager
def read_careless(path, limit):
    columns, notes = arrays_of(path)
    yield columns, Notes()

OWN = Format(write, recognizes=lambda path, begin: begin[:3] == b"OWN", open=read)
CARELESS = dataclasses.replace(OWN, open=read_careless)
SHORT = dataclasses.replace(CARELESS, loses=("units", "notes"))

@hookimpl
def physx_formats():
    return {formats}
"""


@pytest.fixture
def add(tmp_path, monkeypatch):
    """The function that installs a plugin with some of the formats above."""

    def install(name, formats):
        folder = tmp_path / name
        info = folder / f"{name}-1.0.dist-info"
        info.mkdir(parents=True)
        (folder / f"{name}_formats.py").write_text(FORMATS.replace("{formats}", formats))
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[physx]\n{name} = {name}_formats\n")
        monkeypatch.syspath_prepend(folder)

    return install


@pytest.fixture
def stored(tmp_path):
    """A dataset of three rows."""
    with Dataset.create(tmp_path / "stored") as dataset:
        dataset.define_fields("training", [Field("x", (2,), unit="m")])
        dataset.append("training", {"x": [[1, 2], [3, 4], [5, 6]]})
        yield dataset


def test_a_file_that_several_formats_recognize_needs_the_name_of_one(add, stored, tmp_path):
    add("first", '{"own": OWN}')
    file, copy = tmp_path / "file", tmp_path / "copy"
    export(stored, "own", file)
    assert import_file(file, copy) == {"training": 3}
    add("second", '{"other": CARELESS}')
    with pytest.raises(ExchangeError, match="several formats: other, own. Choose .*--from"):
        import_file(file, copy)
    assert import_file(file, tmp_path / "chosen", form="second/other") == {"training": 3}
    with Dataset.open(copy) as right, Dataset.open(tmp_path / "chosen") as without_notes:
        assert right.fields("training")["x"].unit == "m"
        assert without_notes.fields("training")["x"].unit == ""
    with pytest.raises(ComponentNotFoundError, match='no format "ow"'):
        import_file(file, copy, form="ow")
    with pytest.raises(ExchangeError, match="Nothing can be imported from minari"):
        import_file(file, copy, form="minari")


def test_a_broken_format_breaks_no_other(add, stored, tmp_path):
    add("broken", '{"gone": "nowhere:GONE"}')
    export(stored, "npz", tmp_path / "file")
    with pytest.warns(UserWarning, match="The format broken/gone is left out"):
        assert import_file(tmp_path / "file", tmp_path / "copy") == {"training": 3}


@pytest.mark.processes
def test_the_kit_finds_nothing_in_a_right_format(add):
    add("right", '{"own": OWN}')
    (report,) = check_plugin("right")
    assert report.ok and report.counts()["passed"] == 4, str(report)


@pytest.mark.processes
def test_a_format_in_a_script_is_checked_before_it_is_in_a_plugin(tmp_path):
    (tmp_path / "own.py").write_text(FORMATS.replace("{formats}", "{}"))
    (report,) = check_plugin(f"{tmp_path}/own.py:OWN")
    assert (report.kind, report.counts()["passed"]) == ("format", 4), str(report)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("name", "number", "said"),
    [
        ("careless", 2, "the unit of \"state\" is '' instead of 'm'"),
        ("short", 1, "it must raise ExchangeError"),
    ],
)
def test_the_kit_finds_what_is_wrong_with_a_format(add, name, number, said):
    add(name, f'{{"{name}": {name.upper()}}}')
    (report,) = check_plugin(name)
    assert report.counts()["failed"] == number and said in str(report).replace("\n", " ")
