"""Checks that a file format satisfies its contract."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import Dataset, Field
from physx_core.errors import PhysxError
from physx_formats.format import Format
from physx_formats.table import ExportOptions
from physx_formats.transfer.exporting import export
from physx_formats.transfer.importing import import_file
from physx_testing.report import NotApplicableError
from physx_testing.subject import Check, Subject, expect

_ROWS = 12
_FIELDS = (
    Field("state", (2,), unit="m"),
    Field("next_state", (2,), unit="m", role="additional", like="state"),
    Field("points", (3, 2), unit="m"),
    Field("episode", (), "int64", role="additional"),
    Field("step", (), "int64", role="additional"),
)
_VALUES: dict[str, Any] = {"fps": 30, "task": "a task", "points": "points"}


@contextlib.contextmanager
def _rows(folder: Path) -> Iterator[Dataset]:
    """Yield a dataset with one trajectory of 12 rows: states, and a mesh that moves."""
    step = np.arange(_ROWS)
    state = np.stack([np.cos(step / 3), np.sin(step / 3)], axis=1)
    rows = {
        "state": state,
        "next_state": np.roll(state, -1, axis=0),
        "points": state[:, None, :] * np.arange(1, 4)[:, None],
        "episode": np.zeros(_ROWS, int),
        "step": step,
    }
    with Dataset.create(folder) as dataset:
        dataset.define_fields("training", _FIELDS)
        dataset.append("training", rows)
        yield dataset


def _written(subject: Subject) -> Path:
    """Return a file or folder that the format has written."""
    form: Format = subject.make()
    if form.write is None:
        raise NotApplicableError("nothing is exported to it")
    options = ExportOptions(**{name: _VALUES[name] for name in form.options if name in _VALUES})
    place = subject.folder / f"written.{subject.reference.rpartition('/')[2]}"
    with _rows(subject.folder / "session") as dataset:
        done = export(dataset, subject.reference, place, options=options)
    expect(done == {"training": _ROWS}, f"it says that it has written {done}, not {_ROWS} rows")
    return place


def _begin_of(place: Path) -> bytes:
    if place.is_dir():
        return b""
    with place.open("rb") as file:
        return file.read(8)


def _writes(subject: Subject) -> None:
    place = _written(subject)
    expect(place.exists(), "there is no file or folder of the name that it was given")
    left = {each.name for each in subject.folder.iterdir()} - {place.name, "session"}
    expect(not left, f"it leaves {', '.join(sorted(left))} beside what it writes")


def _reads_again(subject: Subject) -> None:
    place, copy = _written(subject), subject.folder / "copy"
    form: Format = subject.make()
    if form.open is None:
        raise NotApplicableError("nothing is imported from it")
    import_file(place, copy, form=subject.reference)
    with Dataset.open(copy) as found, Dataset.open(subject.folder / "session") as wanted:
        for name, field in wanted.fields("training").items():
            expect(name in found.fields("training"), f'it loses the field "{name}"')
            one, other = (each["training"][name][:].reshape(_ROWS, -1) for each in (found, wanted))
            expect(np.array_equal(one, other), f'it changes the values of "{name}" ({field.dtype})')
            _compare(form, field, found.fields("training")[name])


def _compare(form: Format, wanted: Field, found: Field) -> None:
    """Compare what is known of a field, but for what the format says that it loses."""
    for loss, names in (("units", ["unit"]), ("types", ["dtype"]), ("notes", ["role", "like"])):
        for name in names if loss not in form.loses else ():
            one, other = getattr(wanted, name), getattr(found, name)
            expect(
                one == other,
                f'the {name} of "{wanted.name}" is {other!r} instead of {one!r}: keep it, for '
                f'example with Notes, or say that the format loses "{loss}"',
            )


def _recognizes_its_own(subject: Subject) -> None:
    form: Format = subject.make()
    other = subject.folder / "other"
    other.write_bytes(b"nothing that physx knows")
    expect(not form.recognizes(other, _begin_of(other)), "it takes any file for one of its own")
    if form.open is None or form.write is None:
        return
    place = _written(subject)
    expect(form.recognizes(place, _begin_of(place)), "it does not recognize what it has written")


def _refuses_damage(subject: Subject) -> None:
    place = _written(subject)
    if subject.make().open is None or place.is_dir():
        raise NotApplicableError("no single file is imported from it")
    content = place.read_bytes()
    place.write_bytes(content[: len(content) // 2])
    try:
        import_file(place, subject.folder / "copy", form=subject.reference)
    except PhysxError:
        return
    except Exception as error:
        raise AssertionError(
            f"it raises {type(error).__name__}: {error}; it must raise ExchangeError, which says "
            "what is wrong with the file"
        ) from error
    raise AssertionError("it imports a file of which half is missing")


CHECKS: dict[str, Check] = {
    "writes the rows of a dataset": _writes,
    "reads again what it has written": _reads_again,
    "recognizes its own files": _recognizes_its_own,
    "refuses a file of which half is missing": _refuses_damage,
}
