"""Checks, buffers and stores rows and single samples."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from physx_core import files
from physx_core.dataset.store.definitions import compare_fields, complete_shapes
from physx_core.dataset.store.episode_record import EpisodeRecord
from physx_core.dataset.store.episode_table import EPISODES, TABLE_FIELDS, has_table, mode_index
from physx_core.dataset.store.manifest import Mode
from physx_core.dataset.write.recording import table_rows
from physx_core.dataset.write.row_validation import (
    check_rows,
    count_rows,
    infer_fields,
    stored_form,
)
from physx_core.dataset.write.writer import Writer
from physx_core.errors import ConfigError, UsageError, listed
from physx_core.fields import Field, check_together
from physx_core.rows import RowBuffer, infer_shapes
from physx_core.typing import Batch


class Appender:
    """Converts users' rows to the form the writer stores: see `Dataset` for the methods.

    Attributes:
        writer: Stores the rows.
    """

    def __init__(self, writer: Writer) -> None:
        self._store, self._manifest = writer.store, writer.store.manifest
        self.writer = writer
        self._buffers: dict[str, RowBuffer] = {}

    def define_fields(self, mode: str, fields: Iterable[Field]) -> None:
        """Define the fields of a mode: see `Dataset.define_fields`."""
        self.define_modes({mode: fields})

    def define_modes(self, modes: Mapping[str, Iterable[Field]]) -> None:
        """Define the fields of several modes; of none if one already has different fields."""
        wanted = {name: {field.name: field for field in fields} for name, fields in modes.items()}
        for name, given in wanted.items():
            if not name.isidentifier() or not given:
                names = sorted(given) or "no fields"
                raise ConfigError(
                    "A mode needs an identifier as its name and at least one field, not "
                    f"{name!r} with {names}."
                )
            check_together(given)
        known = self._manifest.modes
        if all(
            n in known and _complete(n, known[n], g) == known[n].fields for n, g in wanted.items()
        ):
            return
        with (
            files.storing(f"The fields of mode {listed(wanted)}"),
            self._store.change() as manifest,
        ):
            for name, given in wanted.items():
                mode = manifest.modes.setdefault(name, Mode(given))
                mode.fields = _complete(name, mode, given)

    def append(self, mode: str, rows: Mapping[str, Any], *, checked: bool = False) -> None:
        """Store and commit rows: see `Dataset.append`."""
        known = self._manifest.modes.get(mode)
        if checked and known and (count := count_rows(known.fields, rows)) is not None:
            if self._buffers:
                self._flush(mode)
            self.writer.append(mode, dict(rows), count)
            return
        block, count = self._check_rows(mode, rows, checked=checked)
        self._flush(mode)
        self.writer.append(mode, block, count)

    def _check_rows(
        self, mode: str, rows: Mapping[str, Any], *, checked: bool
    ) -> tuple[Batch, int]:
        """Return rows of a mode as they are stored, and their number; define missing shapes."""
        known = self._manifest.modes.get(mode)
        fields = known.fields if known else {field.name: field for field in infer_fields(rows)}
        block, count = check_rows(fields, rows, checked=checked)
        if not self._is_settled(mode):
            self.define_fields(mode, infer_shapes(fields.values(), block, axes=1))
        return block, count

    def append_episodes(
        self,
        mode: str,
        rows: Mapping[str, Any],
        episodes: Sequence[EpisodeRecord],
        *,
        episode_fields: Iterable[Field] = (),
        checked: bool = False,
        first_row: int | None = None,
    ) -> None:
        """Store rows with the records that commit them: see `Dataset.append_episodes`."""
        recorder = self.writer.recorder
        mode_index(mode)  # it must be one that can hold episodes
        total = sum(each.rows for each in episodes)
        if first_row is not None:
            self._check_written(mode, first_row, total)
        elif total:
            self.writer.check_alone([mode])
        recorder.check(mode, episodes)
        table = self._check_table(mode, episodes, episode_fields) if episodes else {}
        block, count = self._check_rows(mode, rows, checked=checked) if rows else ({}, 0)
        if total != count and first_row is None:
            raise UsageError(f"{count} rows are given, but the episodes have {total}.")
        self._flush(mode)
        if episodes:
            recorder.append(mode, block, total, episodes, table, first_row)

    def _check_written(self, mode: str, first_row: int, count: int) -> None:
        """Check that another process has written rows with these addresses."""
        delegation = self.writer.delegation(mode)
        if delegation is None or not delegation.has(first_row, count):
            raise UsageError(
                f"No process to which mode {mode!r} is delegated has written {count} rows with "
                f"the address {first_row}."
            )

    def define_episodes(self, parameters: Iterable[Field], episode_fields: Iterable[Field]) -> None:
        """Define the table of episodes unless there is one: see `Dataset.define_episodes`."""
        if not self._is_settled(EPISODES):
            self.define_fields(EPISODES, self._table_fields(parameters, episode_fields).values())

    def _table_fields(
        self, parameters: Iterable[Field], episode_fields: Iterable[Field]
    ) -> dict[str, Field]:
        """Return the fields of the table of episodes, or what they are to be."""
        own = {field.name: field for field in TABLE_FIELDS}
        known = self._manifest.modes.get(EPISODES)
        if known is None:
            return {f.name: f for f in (*parameters, *episode_fields)} | own
        if not has_table(self._manifest):
            compare_fields(f'Mode "{EPISODES}" of the dataset', known.fields, own)
        return known.fields

    def _check_table(
        self, mode: str, episodes: Sequence[EpisodeRecord], episode_fields: Iterable[Field]
    ) -> Batch:
        """Return the records of a mode for the table of episodes, which is defined if needed."""
        is_known = EPISODES in self._manifest.modes
        axes = int(episodes[0].count > 1)
        parameters = [] if is_known else infer_fields(episodes[0].parameters, axes)
        fields = self._table_fields(parameters, episode_fields)
        table, _ = check_rows(fields, table_rows(mode, fields, episodes))
        if not self._is_settled(EPISODES):
            self.define_fields(EPISODES, infer_shapes(fields.values(), table, axes=1))
        return table

    def append_sample(self, mode: str, sample: Mapping[str, Any]) -> None:
        """Buffer one sample: see `Dataset.append_sample`."""
        buffer = self._buffers.get(mode)
        if buffer is None:
            buffer = self._begin(mode, sample)
        else:
            buffer.put(sample, finite=True)
        if buffer.full:
            self._flush(mode)

    def flush(self) -> None:
        """Commit all buffered samples: see `Dataset.flush`."""
        for mode in self._buffers:
            self._flush(mode)

    def _begin(self, mode: str, sample: Mapping[str, Any]) -> RowBuffer:
        """Return a mode's buffer with its first sample, which determines undefined shapes."""
        known = self._manifest.modes.get(mode)
        fields = known.fields.values() if known else infer_fields(sample, axes=0)
        shaped = infer_shapes(fields, sample)
        buffer = RowBuffer(shaped, numbered=False)
        buffer.put(sample, finite=True)
        if not self._is_settled(mode):
            self.define_fields(mode, shaped)
        self._buffers[mode] = buffer
        return buffer

    def _flush(self, mode: str) -> None:
        buffer = self._buffers.get(mode)
        if buffer is not None and buffer.count:
            count, fields = buffer.count, self._manifest.modes[mode].fields
            self.writer.append(mode, stored_form(fields, buffer.take()), count)

    def _is_settled(self, mode: str) -> bool:
        """Return whether all fields of a mode and their shapes are known."""
        known = self._manifest.modes.get(mode)
        return known is not None and all(f.shape is not None for f in known.fields.values())


def _complete(mode: str, known: Mode, given: Mapping[str, Field]) -> dict[str, Field]:
    compare_fields(f'Mode "{mode}" of the dataset', known.fields, given)
    return complete_shapes(known.fields, given)
