"""WrittenRows: the server's view of the rows that clients write to their own partitions."""

from __future__ import annotations

import hmac
import socket
from collections.abc import Callable
from typing import Any

from physx_core.dataset.write.delegation import PROOF, Delegation, Share
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import decode, encode
from physx_core.typing import Batch
from physx_core.workers.server.peer import Peer


class WrittenRows:
    """Gives clients partitions to write, and takes note of the rows that they report.

    Attributes:
        dispatch: Handles the messages of a client, by their kind.
    """

    def __init__(self, delegation: Delegation) -> None:
        """Store what begins the partitions."""
        self._delegation = delegation
        self._proven: set[Peer] = set()
        self._shares: dict[Peer, Share] = {}
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.FOLDER: self._take_folder,
            Kind.PARTITION: self._give_partition,
            Kind.SEALED: self._take_sealed,
        }

    def describe(self) -> dict[str, str]:
        """Return what a client needs to know to find the folder."""
        return {
            "host": socket.gethostname(),
            "directory": str(self._delegation.directory.resolve()),
            "file": PROOF,
        }

    def take(self, peer: Peer, first: int, rows: int) -> None:
        """Take note of rows that a client has written, from an address on."""
        share = self._shares.get(peer)
        try:
            if share is None:
                raise ValueError(f"{rows} rows without a partition")
            share.take(first, rows)
        except ValueError as error:
            raise ConnectionRefusedByPeerError(f"It wrote {error}.") from error

    def read(self, first: int, rows: int) -> Batch:
        """Return rows that a client has written, from an address on."""
        return self._delegation.read(first, rows)

    def lose(self, peer: Peer) -> None:
        """Seal what a client that is gone leaves open."""
        self._proven.discard(peer)
        share = self._shares.pop(peer, None)
        if share is not None:
            self._delegation.end(share)

    def _take_folder(self, peer: Peer, frame: Frame) -> None:
        if not hmac.compare_digest(bytes(frame.payload), self._delegation.proof.encode()):
            raise ConnectionRefusedByPeerError(
                f"What it read in its folder {self._delegation.directory.resolve()} is not what "
                "the run wrote there: it is not the same folder."
            )
        self._proven.add(peer)

    def _give_partition(self, peer: Peer, frame: Frame) -> None:
        if peer not in self._proven or not peer.has_told_fields:
            raise ConnectionRefusedByPeerError("It asked for a partition too early.")
        share = self._shares.get(peer)
        if share is None:
            share = self._shares[peer] = self._delegation.share(peer.row_fields)
        entry = share.begin()
        plain: dict[str, Any] = {
            "mode": entry.mode,
            "session": entry.session,
            "index": entry.index,
            "first_row": entry.first_row,
            "capacity": share.capacity,
        }
        peer.send_once(pack(Kind.PARTITION, encode(plain)))

    def _take_sealed(self, peer: Peer, frame: Frame) -> None:
        checksums, share = decode(frame.payload), self._shares.get(peer)
        is_valid = (
            isinstance(checksums, dict)
            and share is not None
            and checksums.keys() == {field.name for field in share.fields}
            and all(type(value) is int and 0 <= value < 2**32 for value in checksums.values())
        )
        if self._delegation.is_closed:
            return  # it has been sealed here
        if not is_valid or share is None or not share.accept(frame.number, checksums):
            raise ConnectionRefusedByPeerError(f"It did not seal its partition {frame.number}.")
