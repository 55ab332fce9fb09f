"""Merges the tables of episodes of two datasets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store import failure_file
from physx_core.dataset.store.episode_record import OPEN, EpisodeStatus
from physx_core.dataset.store.episode_table import EPISODES, RECORDED, has_table, mode_index
from physx_core.dataset.store.manifest import Manifest
from physx_core.dataset.write.recording import Recorder, stream_record
from physx_core.rows import concatenate
from physx_core.typing import Batch


class MergedRecords:
    """The records that merging another dataset adds to the table of episodes.

    The other's campaigns follow the dataset's own. Rows without records, on either side, become
    those of a stream if the mode has records on the other side.

    Attributes:
        rows: The records, by field; empty if there are none.
        count: Their number.
    """

    def __init__(self, recorder: Recorder, source: Path, given: Manifest) -> None:
        """Make the records, before any partition of the other dataset is listed.

        Args:
            recorder: Knows the dataset's own records.
            source: Folder of the other dataset.
            given: Its manifest.
        """
        self._recorder, self._source = recorder, source
        self._manifest, self._given = recorder.manifest, given
        self._campaigns = {mode: recorder.next_campaign(mode) for mode in RECORDED}
        self._other = Reader(source, given).table() if has_table(given) else {}
        parts = [part for mode in RECORDED for part in self._merge(mode)]
        self.rows = concatenate(parts)
        self.count = len(self.rows["rows"]) if parts else 0

    def take_effect(self) -> None:
        """Take note of the records once they are stored, and store why episodes failed."""
        if not self.count:
            return
        self._recorder.load()
        self._recorder.store_reasons(
            failure._replace(campaign=failure.campaign + self._campaigns[failure.mode])
            for failure in failure_file.read(self._source)
            if failure.mode in self._campaigns
        )

    def _merge(self, mode: str) -> list[Batch]:
        """Return the further records of a mode."""
        about = self._other.get("mode_index", np.zeros(0)) == mode_index(mode)
        others = {name: column[about] for name, column in self._other.items()}
        is_own = self._recorder.has_records(mode)
        if not (is_own or about.any()):
            return []
        fields = self._manifest.modes[EPISODES].fields
        found, campaign = [], self._campaigns[mode]
        if campaign and (stream := self._recorder.ended_stream(mode)) is not None:
            found.append(stream_record(fields, mode, *stream))
        known, other = self._manifest.modes.get(mode), self._given.modes.get(mode)
        shift = 0 if known is None else known.next_row
        end = 0 if other is None else Addresses(other).end
        if not about.any():
            return [*found, stream_record(fields, mode, campaign, shift, end)]
        is_open = (others["status"] == EpisodeStatus.STREAM) & (others["rows"] == OPEN)
        others["rows"] = np.where(is_open, end - others["first_row"], others["rows"])
        others["first_row"] = others["first_row"] + shift
        others["campaign"] = others["campaign"] + campaign
        return [*found, others]
