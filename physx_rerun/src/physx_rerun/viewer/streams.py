"""RecordingStreams: writes a recording to a file, to a live viewer, or to both."""

from __future__ import annotations

import contextlib
import queue
import threading
import uuid
import warnings
from collections.abc import Iterable
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from physx_core.errors import VisualizerError
from physx_rerun.drawing.chunks import Chunk

QUEUE_BYTES = 64_000_000
"""Largest size of the rows that wait for a live viewer; further rows are dropped."""
QUEUE_LENGTH = 4096
"""Largest number of chunks that wait for a live viewer; further rows are dropped."""
CLOSE_SECONDS = 3.0
"""Time that the end of a run waits for a live viewer."""


class RecordingStreams:
    """A run's recording. The file gets all rows, a live viewer those that it can keep up with."""

    def __init__(
        self,
        application_id: str,
        run_name: str,
        path: Path | None,
        address: str | None,
        *,
        owns_viewer: bool,
    ) -> None:
        """Open the streams.

        Args:
            application_id: Name under which viewers store the user's layout.
            run_name: Name of the recording.
            path: File to write; None: none.
            address: Address of a live viewer, ``HOST:PORT``; None: none.
            owns_viewer: Whether the viewer was started for this run, so that its layout can be
                replaced.
        """
        self._owns_viewer = owns_viewer
        recording_id = str(uuid.uuid4())
        self._file = rr.RecordingStream(application_id, recording_id=recording_id) if path else None
        if self._file and path:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file.save(path)
            except (OSError, RuntimeError) as error:
                raise VisualizerError(
                    f"The recording {path} cannot be written: {error}."
                ) from error
            self._file.send_recording_name(run_name)
        self._live = (
            LiveWriter(application_id, recording_id, run_name, address) if address else None
        )

    def write(self, chunks: Iterable[Chunk]) -> None:
        """Write chunks, without waiting for a live viewer."""
        for chunk in chunks:
            if self._file:
                chunk.send(self._file)
            if self._live:
                self._live.put(chunk)

    def write_blueprint(self, blueprint: rrb.Blueprint) -> None:
        """Write the layout of the windows."""
        if self._file:
            self._file.send_blueprint(blueprint)
        if self._live:
            self._live.put(_QueuedBlueprint(blueprint, make_active=self._owns_viewer))

    def close(self) -> None:
        """Finish the file and disconnect the live viewer; warn of rows that it did not get."""
        if self._file:
            self._file.disconnect()
            self._file = None
        if self._live:
            self._live.close()
            self._live = None


class _QueuedBlueprint:
    """The layout of the windows, queued for a live viewer."""

    is_static = True
    nbytes = 0

    def __init__(self, blueprint: rrb.Blueprint, *, make_active: bool) -> None:
        self._blueprint, self._make_active = blueprint, make_active

    def send(self, stream: rr.RecordingStream) -> None:
        """Write the layout to a stream."""
        stream.send_blueprint(self._blueprint, make_active=self._make_active)


class LiveWriter:
    """Writes to a live viewer in a thread of its own, as a hanging viewer blocks its writer.

    Attributes:
        dropped: Chunks that were dropped because the viewer could not keep up.
    """

    def __init__(self, application_id: str, recording_id: str, run_name: str, address: str) -> None:
        """Start the thread.

        Args:
            application_id: As in `RecordingStreams`.
            recording_id: Identity of the recording, the same as the file's.
            run_name: Name of the recording.
            address: Address of the viewer, ``HOST:PORT``.
        """
        self.dropped = 0
        self._address = address
        self._queue: queue.SimpleQueue[Chunk | _QueuedBlueprint | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting_bytes = 0
        self._failure: BaseException | None = None
        self._thread = threading.Thread(
            target=self._run,
            args=(application_id, recording_id, run_name),
            name="physx-rerun",
            daemon=True,
        )
        self._thread.start()

    def put(self, item: Chunk | _QueuedBlueprint) -> None:
        """Queue an item; rows are dropped while the queue is full, static data never."""
        with self._lock:
            is_full = self._waiting_bytes > QUEUE_BYTES or self._queue.qsize() > QUEUE_LENGTH
            if is_full and not item.is_static:
                self.dropped += 1
                return
            self._waiting_bytes += item.nbytes
        self._queue.put(item)

    def close(self) -> None:
        """Give the viewer some time to receive the rest, then disconnect."""
        self._queue.put(None)
        self._thread.join(CLOSE_SECONDS)
        if self._thread.is_alive():
            # Rerun would otherwise wait for the viewer when the interpreter ends.
            rr.unregister_shutdown()
            warnings.warn(f"The Rerun viewer at {self._address} does not respond.", stacklevel=3)
        elif self._failure is not None:
            text = f"The Rerun viewer at {self._address} disconnected: {self._failure}."
            warnings.warn(text, stacklevel=3)
        if self.dropped:
            warnings.warn(
                f"The Rerun viewer at {self._address} was too slow: it missed "
                f"{self.dropped} blocks of rows. A saved file contains them.",
                stacklevel=3,
            )

    def _run(self, application_id: str, recording_id: str, run_name: str) -> None:
        stream = rr.RecordingStream(application_id, recording_id=recording_id)
        try:
            stream.connect_grpc(f"rerun+http://{self._address}/proxy")
            stream.send_recording_name(run_name)
            while (item := self._queue.get()) is not None:
                item.send(stream)
                with self._lock:
                    self._waiting_bytes -= item.nbytes
            stream.flush(timeout_sec=CLOSE_SECONDS)
        except Exception as error:  # a viewer can fail in any way, which must not end a run
            self._failure = error
        with contextlib.suppress(Exception):
            stream.disconnect()
