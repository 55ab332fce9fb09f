"""WrittenRows: the server's view of the rows that clients write to their own partitions."""

from __future__ import annotations

import hmac
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from physx_core.dataset.store.manifest import Partition, has_statistics, rows_of_stripe
from physx_core.dataset.write.stripes import PROOF, Stripes
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.fields import Field
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import decode, encode
from physx_core.statistics import RunningStatistics
from physx_core.workers.server.peer import Peer


class WrittenRows:
    """Tells clients which partitions to write, and counts the rows that they report.

    Attributes:
        dispatch: Handles the messages of a client, by their kind.
    """

    def __init__(self, stripes: Stripes) -> None:
        """Store the stripes, which keep the partitions."""
        self._stripes = stripes
        self._proven: set[Peer] = set()
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.FOLDER: self._take_folder,
            Kind.WRITTEN: self._take_written,
            Kind.SEALED: self._take_sealed,
        }

    def describe(self, peer: Peer) -> dict[str, Any]:
        """Return what a client needs to know when it starts: the folder, and its partitions."""
        stripes = self._stripes
        known = stripes.entries(peer.instance_id - 1)
        return {
            "host": socket.gethostname(),
            "directory": str(stripes.directory.resolve()),
            "file": PROOF,
            "place": peer.instance_id - 1,
            "partitions": [(number, self._plain(entry)) for number, entry in known.items()],
        }

    def define(self, fields: Sequence[Field]) -> None:
        """Define the fields of the rows."""
        self._stripes.define(fields)

    def extend(self, granted: Mapping[Peer, int]) -> None:
        """Begin partitions for the rows that clients will be allowed to generate."""
        stripes = self._stripes
        while stripes.begun * stripes.capacity < max(granted.values()):
            number = stripes.begun
            stripes.begin()
            for peer in granted:
                entry = stripes.entries(peer.instance_id - 1)[number]
                peer.send_once(pack(Kind.PARTITION, encode(self._plain(entry)), number))

    def commit(self, total: int) -> None:
        """Make the first `total` rows part of the dataset."""
        self._stripes.commit(total)

    def end(self, peers: Iterable[Peer]) -> None:
        """Order clients to seal what they wrote, up to the first missing row."""
        for peer in peers:
            share = rows_of_stripe(self._stripes.whole, peer.instance_id - 1, self._stripes.count)
            peer.send_once(pack(Kind.SEAL, number=share))

    def _plain(self, entry: Partition) -> dict[str, Any]:
        return {
            "mode": entry.mode,
            "session": entry.session,
            "index": entry.index,
            "first_row": entry.first_row,
            "stripe": entry.stripe and tuple(entry.stripe),
            "capacity": self._stripes.capacity,
            "fields": [field.to_dict() for field in self._stripes.fields],
        }

    def _take_folder(self, peer: Peer, frame: Frame) -> None:
        if not hmac.compare_digest(bytes(frame.payload), self._stripes.proof.encode()):
            raise ConnectionRefusedByPeerError(
                f"What it read in its folder {self._stripes.directory.resolve()} is not what the "
                "run wrote there: it is not the same folder."
            )
        self._proven.add(peer)

    def _take_written(self, peer: Peer, frame: Frame) -> None:
        if peer not in self._proven or not peer.has_told_fields:
            raise ConnectionRefusedByPeerError("It wrote rows before it said where, and which.")
        if not peer.received < frame.number <= peer.granted:
            raise ConnectionRefusedByPeerError(
                f"It wrote {frame.number - peer.received} rows that nobody asked for."
            )
        peer.pace.rows(frame.number - peer.received, goes_on=frame.number < peer.granted)
        peer.received = frame.number
        self._stripes.note(peer.instance_id - 1, peer.received)

    def _take_sealed(self, peer: Peer, frame: Frame) -> None:
        try:
            rows, checksums, running = self._parse_sealed(decode(frame.payload))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConnectionRefusedByPeerError(
                f"It sealed a partition with impossible numbers: {error}."
            ) from error
        place, number = peer.instance_id - 1, frame.number
        begin = number * self._stripes.capacity
        accepted = peer in self._proven and begin + rows <= peer.received
        if not accepted or not self._stripes.accept(place, number, rows, checksums, running):
            raise ConnectionRefusedByPeerError(f"It did not seal its partition {number}.")

    def _parse_sealed(self, plain: Any) -> tuple[int, dict[str, int], dict[str, RunningStatistics]]:
        rows, checksums, running = plain["rows"], plain["checksums"], plain["statistics"]
        fields = {field.name: field for field in self._stripes.fields}
        if type(rows) is not int or not 0 < rows <= self._stripes.capacity:
            raise ValueError(f"{rows!r:.20} rows")
        if checksums.keys() != fields.keys() or not all(
            type(value) is int and 0 <= value < 2**32 for value in checksums.values()
        ):
            raise ValueError("its checksums")
        counted = {name for name, field in fields.items() if has_statistics(field)}
        if running.keys() != counted:
            raise ValueError("its statistics")
        found = {
            name: RunningStatistics.from_arrays(arrays, fields[name].shape or ())
            for name, arrays in running.items()
        }
        if any(statistics.count != rows for statistics in found.values()):
            raise ValueError("the counts of its statistics")
        return rows, checksums, found
