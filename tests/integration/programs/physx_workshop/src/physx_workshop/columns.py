"""Text files with a column for each component of the fields."""

import contextlib

import numpy as np

from physx_formats import Format, Notes

_BEGIN = b"columns:"


def _write(tables, path, options):
    (table,) = tables
    values = [np.concatenate([block for _, block in table.column(name)]) for name in table.fields]
    flat = [each.reshape(table.rows, -1) for each in values]
    names = [name for name, each in zip(table.fields, flat, strict=True) for _ in each.T]
    rows = np.concatenate(flat, axis=1)
    np.savetxt(path, rows, fmt="%.17g", header=" ".join(names), comments="columns:")
    return 0


class _Column:
    unit = problem = ""

    def __init__(self, values):
        self._values, self.shape, self.dtype = values, values.shape, values.dtype

    def read(self, start, count):
        return self._values[start : start + count]


@contextlib.contextmanager
def _open(path, limit):
    with path.open() as file:
        names = file.readline().removeprefix(_BEGIN.decode()).split()
        rows = np.loadtxt(file, ndmin=2)
    chosen = {name: [each == name for each in names] for name in names}
    yield {name: _Column(rows[:, which]) for name, which in chosen.items()}, Notes()


COLUMNS = Format(_write, recognizes=lambda path, begin: begin == _BEGIN, open=_open)
