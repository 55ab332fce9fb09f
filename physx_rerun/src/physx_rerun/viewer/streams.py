"""RecordingStreams: writes a recording to a file, to live viewers, or both."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from physx_core.errors import VisualizerError
from physx_core.processes import BackgroundThread
from physx_rerun.drawing.chunks import Chunk
from physx_rerun.viewer.viewer import connect

QUEUE_BYTES = 64_000_000
"""Largest size of the rows queued for a live viewer; further rows are dropped."""
QUEUE_LENGTH = 4096
"""Largest number of chunks queued for a live viewer; further rows are dropped."""
CLOSE_SECONDS = 2.5
"""Time that a run waits for live viewers at its end."""
RETRY_SECONDS = 2.0
"""Time between attempts to reach a live viewer that is not running."""

_FRAME = "Transform3D:child_frame"


class RecordingStreams:
    """A run's recording. The file gets all rows, live viewers get as many as they can handle."""

    def __init__(
        self,
        application_id: str,
        run_name: str,
        path: Path | None,
        addresses: Sequence[str],
        *,
        owns_viewer: bool,
    ) -> None:
        """Open the streams.

        Args:
            application_id: Name under which viewers store the user's layout.
            run_name: Name of the recording.
            path: File to write; None: none.
            addresses: Addresses of live viewers, ``HOST:PORT``.
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
        self._live = [
            LiveWriter(application_id, recording_id, run_name, address) for address in addresses
        ]

    def write(self, chunks: Iterable[Chunk]) -> None:
        """Write chunks, without waiting for live viewers."""
        for chunk in chunks:
            if self._file:
                chunk.send(self._file)
            for live in self._live:
                live.put(chunk)

    def write_blueprint(self, blueprint: rrb.Blueprint) -> None:
        """Write the layout of the windows."""
        if self._file:
            self._file.send_blueprint(blueprint)
        for live in self._live:
            live.put(_QueuedBlueprint(blueprint, make_active=self._owns_viewer))

    def close(self) -> None:
        """Finish the file and disconnect live viewers; warn about rows that they did not get."""
        if self._file:
            self._file.disconnect()
            self._file = None
        for live in self._live:
            live.end()
        deadline = time.monotonic() + CLOSE_SECONDS
        while self._live:
            self._live.pop(0).close(deadline)


class _QueuedBlueprint:
    """The layout of the windows, queued for a live viewer."""

    is_static = True
    nbytes = 0

    def __init__(self, blueprint: rrb.Blueprint, *, make_active: bool) -> None:
        self._blueprint, self._make_active = blueprint, make_active

    def send(self, stream: rr.RecordingStream) -> None:
        """Write the layout to a stream."""
        stream.send_blueprint(self._blueprint, make_active=self._make_active)


_Item = Chunk | _QueuedBlueprint


class LiveWriter:
    """Writes to a live viewer in a separate thread, because a hanging viewer blocks its writer.

    The viewer need not be running. One that is started later, or restarted, gets the layout and the
    last state of everything, and all rows from then on.

    Attributes:
        missed: Blocks of rows that the viewer did not get because it was too slow or not running.
    """

    def __init__(self, application_id: str, recording_id: str, run_name: str, address: str) -> None:
        """Start the thread.

        Args:
            application_id: As in `RecordingStreams`.
            recording_id: Identity of the recording, the same as the file's.
            run_name: Name of the recording.
            address: Address of the viewer, ``HOST:PORT``.
        """
        self.missed = 0
        self._identity = (application_id, recording_id, run_name)
        self._address = address
        self._queue: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting_bytes = 0
        self._state = _LastState()
        self._stream: rr.RecordingStream | None = None
        self._canary: socket.socket | None = None
        self._failure: BaseException | None = None
        self._thread = BackgroundThread(self._run, "physx-rerun")
        self._thread.start()

    def put(self, item: _Item) -> None:
        """Queue an item; rows are dropped while the queue is full, static data never are."""
        with self._lock:
            is_full = self._waiting_bytes > QUEUE_BYTES or self._queue.qsize() > QUEUE_LENGTH
            if is_full and not item.is_static:
                self.missed += 1
                return
            self._waiting_bytes += item.nbytes
        self._queue.put(item)

    def end(self) -> None:
        """End the thread once it has sent everything in the queue."""
        self._queue.put(None)

    def close(self, deadline: float) -> None:
        """Wait until the viewer has received everything; warn if it has not.

        Args:
            deadline: Time at which to give up, as of `time.monotonic`.
        """
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._thread.is_alive():
            # Otherwise, Rerun would wait for the viewer when the interpreter exits.
            rr.unregister_shutdown()
            problem = "does not respond"
        elif self._failure is not None:
            problem = f"disconnected ({self._failure})"
        elif self._stream is None:
            problem = "was never reachable"
        elif self.missed:
            problem = "was too slow, or not always reachable"
        else:
            return
        warnings.warn(
            f"The Rerun viewer at {self._address} {problem}: it missed {self.missed} blocks of "
            "rows. A saved file contains them.",
            stacklevel=3,
        )

    def _run(self) -> None:
        look_at, is_over = 0.0, False
        while not is_over:
            item = None
            with contextlib.suppress(queue.Empty):
                item = self._queue.get(timeout=RETRY_SECONDS)
                is_over = item is None
            if self._stream is not None and self._is_gone():
                self._disconnect(ConnectionError("it closed the connection"))
            if self._stream is None and (is_over or time.monotonic() >= look_at):
                self._connect()
                look_at = time.monotonic() + RETRY_SECONDS
            if item is not None:
                self._send(item)
        stream = self._stream
        if stream is not None:
            with self._disconnecting_on_failure():
                stream.flush(timeout_sec=CLOSE_SECONDS)
            stream.disconnect()

    def _send(self, item: _Item) -> None:
        self._state.add(item)
        if self._stream is not None:
            with self._disconnecting_on_failure():
                item.send(self._stream)
        with self._lock:
            self._waiting_bytes -= item.nbytes
            self.missed += self._stream is None and not item.is_static

    def _connect(self) -> None:
        """Connect to the viewer if it is running, and send it what it has missed."""
        # Rerun's own connection takes 5 s if nobody listens, and never reports that it is lost.
        self._canary = connect(self._address)
        if self._canary is None:
            return
        self._canary.setblocking(False)
        application_id, recording_id, run_name = self._identity
        with self._disconnecting_on_failure():
            self._stream = rr.RecordingStream(application_id, recording_id=recording_id)
            self._stream.connect_grpc(f"rerun+http://{self._address}/proxy")
            self._stream.send_recording_name(run_name)
            for item in self._state.items():
                item.send(self._stream)
            self._failure = None

    def _is_gone(self) -> bool:
        """Return whether the viewer has closed its end of the connection."""
        assert self._canary is not None
        try:
            return not self._canary.recv(1024)
        except BlockingIOError:
            return False
        except OSError:
            return True

    @contextlib.contextmanager
    def _disconnecting_on_failure(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a viewer can fail in any way, which must not end the run
            self._disconnect(error)

    def _disconnect(self, reason: Exception) -> None:
        self._failure = reason
        with self._lock:
            self.missed += 1  # at least the rows in transit
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(Exception):
                stream.disconnect()
        if self._canary is not None:
            self._canary.close()


class _LastState:
    """The last value of everything drawn, for a viewer that has missed it."""

    def __init__(self) -> None:
        self._count = 0
        self._items: dict[tuple[str, ...], tuple[int, _Item]] = {}

    def add(self, item: _Item) -> None:
        """Add an item, and remove those that it overrides."""
        self._count += 1
        for key in _keys(item):
            self._items[key] = (self._count, item)

    def items(self) -> list[_Item]:
        """Return the items that are not overridden, in the order in which they were added."""
        numbered = dict(self._items.values())
        return [numbered[number] for number in sorted(numbered)]


def _keys(item: _Item) -> Iterable[tuple[str, ...]]:
    """Return keys of what an item sets: an entity's components, for each frame that it moves."""
    if not isinstance(item, Chunk):
        return [("blueprint",)]
    columns = {str(column.component_descriptor()): column for column in item.columns}
    if _FRAME not in columns:
        return [(item.entity, *columns)]
    moved = columns[_FRAME].as_arrow_array().flatten().unique().to_pylist()
    return [(item.entity, *columns, frame) for frame in moved]
