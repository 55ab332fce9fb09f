"""Computes digests of large blocks in parallel with the thread that writes them."""

from __future__ import annotations

from queue import SimpleQueue

from physx_core.dataset.store.partition.commits import BlockDigests
from physx_core.processes import BackgroundThread

LARGE = 2**17
"""Bytes from which a second thread saves more time than it costs."""


class Digester:
    """Updates digests; large blocks are hashed in a thread that starts with the first of them.

    Hashing reads memory about as fast as the system copies it into the page cache: in parallel with
    the copying it takes no extra time, after it a fifth more.

    Attributes:
        pending: Number of updates that are not finished yet.
    """

    def __init__(self) -> None:
        self._blocks: SimpleQueue[tuple[BlockDigests, memoryview] | None] = SimpleQueue()
        self._done: SimpleQueue[None] = SimpleQueue()
        self.pending = 0
        self._thread: BackgroundThread | None = None

    def update(self, digests: BlockDigests, content: memoryview) -> None:
        """Add bytes to digests, which are up to date once `wait` has returned."""
        if len(content) < LARGE:
            self.wait()
            digests.update(content)
            return
        if self._thread is None:
            self._thread = BackgroundThread(self._run, "physx-digest")
            self._thread.start()
        self._blocks.put((digests, content))
        self.pending += 1

    def wait(self) -> None:
        """Wait until all digests are up to date."""
        while self.pending:
            self._done.get()
            self.pending -= 1

    def close(self) -> None:
        """Stop the thread."""
        self._blocks.put(None)
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while (block := self._blocks.get()) is not None:
            digests, content = block
            digests.update(content)
            del block, digests, content
            self._done.put(None)
