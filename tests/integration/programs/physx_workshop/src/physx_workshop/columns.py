"""Text files with a column for each component of the fields."""

import contextlib

import numpy as np

from physx_formats import ArrayColumn, ExchangeError, Format, Notes

_BEGIN = b"columns:"


def _write(tables, path, options):
    (table,) = tables
    values = [np.concatenate([block for _, block in table.column(name)]) for name in table.fields]
    flat = [each.reshape(table.rows, -1) for each in values]
    names = [name for name, each in zip(table.fields, flat, strict=True) for _ in each.T]
    rows = np.concatenate(flat, axis=1)
    np.savetxt(path, rows, fmt="%.17g", header=" ".join(names), comments="columns:")
    return 0


@contextlib.contextmanager
def _open(path, limit):
    with path.open() as file:
        names = file.readline().removeprefix(_BEGIN.decode()).split()
        try:
            rows = np.loadtxt(file, ndmin=2)
        except ValueError as error:
            raise ExchangeError(f"{path} holds no table: {error}.") from error
    chosen = {name: [each == name for each in names] for name in names}
    yield {name: ArrayColumn(rows[:, which]) for name, which in chosen.items()}, Notes()


_LOSSES = ("units", "types", "notes", "records")
COLUMNS = Format(_write, recognizes=lambda path, begin: begin == _BEGIN, open=_open, loses=_LOSSES)
