"""Writes the virtual index ``<session>.h5``: all sealed rows in one file, for other tools.

It holds ``/<mode>/<field>`` as virtual datasets that refer to the partitions in the same folder. If
several sessions wrote the dataset, there is one index named after each, and each shows all rows.
physx itself never reads them.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.fields import Field

FORMAT = "physx index"


def write_index(directory: Path, session: str, manifest: Manifest, *, wait: bool = False) -> None:
    """Write the index of all sealed rows.

    Args:
        directory: The dataset's folder.
        session: Session that writes it; it gets an index even if it has no rows yet.
        manifest: The dataset's manifest.
        wait: Whether to wait for the disk.
    """
    import h5py

    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, 1
        for name, mode in manifest.modes.items():
            group = file.create_group(name)
            for field in mode.fields.values():
                if field.shape is not None:
                    _add(group, mode, field)
    for name in {session, *manifest.sessions}:
        files.replace(directory / f"{name}.h5", image.getvalue(), wait=wait)


def _add(group: Any, mode: Mode, field: Field) -> None:
    import h5py

    sealed = Mode(mode.fields, [partition for partition in mode.partitions if partition.sealed])
    rows = sealed.rows
    shape, dtype = (rows, *(field.shape or ())), np.dtype(field.dtype)
    if not rows or not field.nbytes:
        entry = group.create_dataset(field.name, shape, dtype)
    else:
        layout = h5py.VirtualLayout(shape, dtype)
        for partition, span in zip(sealed.partitions, sealed.spans, strict=True):
            source_shape = (partition.rows, *shape[1:])
            source_file = partition.file_name(field.name)
            source = h5py.VirtualSource(source_file, "data", source_shape, dtype)
            layout[span.among(0, span.rows, 0)] = source
        missing = np.nan if dtype.kind == "f" else None  # value of rows of a lost partition
        entry = group.create_virtual_dataset(field.name, layout, fillvalue=missing)
    entry.attrs["unit"], entry.attrs["role"] = field.unit, field.role
