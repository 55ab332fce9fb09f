"""Export: the rows of a dataset as one file or folder of another format."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from physx_core.dataset.dataset import Dataset
from physx_core.dataset.exchange import hdf5_format as hdf5
from physx_core.dataset.exchange import minari_format as minari_episodes
from physx_core.dataset.exchange import npz_format as npz
from physx_core.dataset.exchange import parquet_format as parquet
from physx_core.dataset.exchange import zarr_format as zarr_groups
from physx_core.dataset.exchange.table import Advance, Table
from physx_core.errors import ConfigError, ExchangeError, PhysxError, listed, nearest


@dataclass(frozen=True)
class ExportOptions:
    """What a format may be told.

    Attributes:
        compression: Name of the format's compression, or "none".
        observations: Fields that are the observations of an episode (minari only); empty: all
            training fields that are nothing else.
        actions: Fields that are its actions (minari only).
        rewards: Field that is its rewards (minari only); None: they are 0.
    """

    compression: str = "none"
    observations: Sequence[str] = ()
    actions: Sequence[str] = ()
    rewards: str | None = None


@dataclass(frozen=True)
class Format:
    """A format that datasets are exported to.

    Attributes:
        write: Writes tables to a path; what does not hold all rows returns how many it left out.
        compressions: Names of its compressions, "none" first.
        several: Whether one file holds several modes.
    """

    write: Callable[[Sequence[Table], Path, ExportOptions], int | None]
    compressions: Collection[str]
    several: bool


def _minari(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    roles = minari_episodes.Roles.of(
        tables[0], options.observations, options.actions, options.rewards
    )
    return minari_episodes.write(tables[0], out, roles)


FORMATS = {
    "npz": Format(lambda t, out, o: npz.write(t, out, o.compression), npz.COMPRESSIONS, True),
    "parquet": Format(
        lambda t, out, o: parquet.write(t[0], out, o.compression), parquet.COMPRESSIONS, False
    ),
    "minari": Format(_minari, ("none",), False),
    "zarr": Format(
        lambda t, out, o: zarr_groups.write(t, out, o.compression), zarr_groups.COMPRESSIONS, True
    ),
    "hdf5-single": Format(
        lambda t, out, o: hdf5.write(t, out, o.compression), hdf5.COMPRESSIONS, True
    ),
}
"""The formats by name."""


def export(
    dataset: Dataset,
    to: str,
    out: str | Path,
    *,
    modes: Sequence[str] = (),
    options: ExportOptions | None = None,
    advance: Advance = lambda nbytes: None,
) -> dict[str, int]:
    """Write the rows of a dataset in another format, block by block.

    What is written appears under its name only when it is complete.

    Args:
        dataset: The dataset.
        to: Name of the format, one of `FORMATS`.
        out: The file, or for zarr and minari the folder. There must be nothing yet.
        modes: Names of the modes; empty: all that have rows. Parquet and minari hold one.
        options: What the format is told.
        advance: Is told how many bytes were read.

    Returns:
        How many rows of each mode were written.

    Raises:
        ConfigError: There is no such format or compression, or several modes do not fit.
        ExchangeError: A field does not fit into the format, or the file cannot be written.
        MissingLibraryError: The library of the format is not installed.
        DatasetError: There is no such mode, nothing to write, or a partition is damaged.
    """
    out, options = Path(out), options or ExportOptions()
    form = _format(to, options)
    tables = _tables(dataset, modes, advance)
    if len(tables) > 1 and not form.several:
        raise ConfigError(
            f"{to} holds one mode. Choose one with modes (--mode on the command line): "
            f"{listed(table.mode for table in tables)}."
        )
    if out.exists() or not out.absolute().parent.is_dir():
        why = "is there already" if out.exists() else "would be in a folder that does not exist"
        raise ExchangeError(f"{out} {why}. Choose another place.")
    try:
        with tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".export-") as folder:
            draft = Path(folder) / out.name
            left_out = form.write(tables, draft, options) or 0
            draft.rename(out)
    except PhysxError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise ExchangeError(
            f"{out} cannot be written: {reason}. Nothing was left there."
        ) from error
    return {table.mode: table.rows - left_out for table in tables}


def _format(to: str, options: ExportOptions) -> Format:
    if to not in FORMATS:
        raise ConfigError(
            f'There is no format "{to}".{nearest(to, FORMATS)} Formats: {listed(FORMATS)}.'
        )
    form = FORMATS[to]
    if options.compression not in form.compressions:
        raise ConfigError(
            f'{to} has no compression "{options.compression}". It has: {listed(form.compressions)}.'
        )
    if to != "minari" and (options.observations or options.actions or options.rewards):
        raise ConfigError(f"Observations, actions and rewards are for minari, not for {to}.")
    return form


def _tables(dataset: Dataset, modes: Sequence[str], advance: Advance) -> list[Table]:
    names = modes or [name for name in dataset.modes if dataset.num_samples(name)]
    tables = []
    for name in dict.fromkeys(names):
        rows = dataset.num_samples(name)
        if not rows:
            raise ExchangeError(f'Mode "{name}" has no samples to export.')
        fields = dataset.fields(name)
        tables.append(Table(name, fields, rows, dataset.info, dataset[name], advance))
    if not tables:
        raise ExchangeError(f"The dataset in {dataset.directory} has no samples to export.")
    return tables
