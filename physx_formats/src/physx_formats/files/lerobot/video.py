"""Videos of a feature: pictures to files of limited size, and back."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.files.lerobot.layout import FILE_BYTES, place_of, video_file
from physx_formats.table import import_library

_CODEC = "libx264"
_PIXELS = "yuv444p"
"""Each pixel has its colors, and pictures any size; with 4:2:0, 2 x 2 pixels share them."""
_OPTIONS = {"crf": "18", "g": "2", "bf": "0"}
"""High quality; each second picture is whole, so that any one is found fast."""


class VideoWriter:
    """Writes the pictures of a feature, one episode after another.

    Attributes:
        info: What LeRobot says of its videos, once there are pictures.
    """

    def __init__(self, out: Path, name: str, shape: Sequence[int], fps: int) -> None:
        """Prepare a feature.

        Args:
            out: The dataset's folder.
            name: Name of the feature.
            shape: Height, width, and 3.
            fps: Pictures per second.
        """
        self._av = import_library("av", "Exporting pictures to LeRobot", "lerobot")
        self._out, self._name, self._fps = out, name, fps
        self._height, self._width, _ = shape
        self._file: Any = None
        self._stream: Any = None
        self._files = self._frames = self._nbytes = 0
        self.info = {
            "video.height": self._height,
            "video.width": self._width,
            "video.codec": "h264",
            "video.pix_fmt": _PIXELS,
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        }

    def write(self, blocks: Iterable[Array]) -> dict[str, Any]:
        """Write the pictures of an episode; return where they are, as its record has it.

        Args:
            blocks: Pictures of shape (rows, height, width, 3).
        """
        if self._file is None or self._nbytes > FILE_BYTES:
            self._begin()
        first = self._frames
        for picture in itertools.chain.from_iterable(blocks):
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24")
            frame.pts, self._frames = self._frames, self._frames + 1
            self._mux(frame)
        chunk, number = place_of(self._files - 1)
        found = {
            "chunk_index": chunk,
            "file_index": number,
            "from_timestamp": first / self._fps,
            "to_timestamp": self._frames / self._fps,
        }
        return {f"videos/{self._name}/{key}": value for key, value in found.items()}

    def _begin(self) -> None:
        """Begin another file."""
        self.close()
        path = video_file(self._out, self._name, *place_of(self._files))
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._av.open(str(path), "w")
        self._stream = self._file.add_stream(_CODEC, rate=self._fps, options=_OPTIONS)
        self._stream.width, self._stream.height = self._width, self._height
        self._stream.pix_fmt = _PIXELS
        self._files, self._frames, self._nbytes = self._files + 1, 0, 0

    def _mux(self, frame: Any) -> None:
        """Write a frame; None: what the encoder has kept back."""
        for packet in self._stream.encode(frame):
            self._nbytes += packet.size
            self._file.mux(packet)

    def close(self) -> None:
        """Write what is left of the last file."""
        if self._file is None:
            return
        with self._file:
            self._mux(None)
        self._file = None


@dataclass(frozen=True)
class Clip:
    """Where the pictures of an episode are.

    Attributes:
        path: The video.
        start: Time of the first one in it, in s.
        count: Number of them.
    """

    path: Path
    start: float
    count: int


class Pictures:
    """The pictures of a feature, read from its videos in sequence; see `Column`."""

    unit = problem = ""
    dtype = np.dtype(np.uint8)

    def __init__(self, clips: Sequence[Clip], shape: Sequence[int], fps: float) -> None:
        """Keep where they are.

        Args:
            clips: The episodes in order.
            shape: Height, width, and 3.
            fps: Pictures per second.
        """
        self._av = import_library("av", "Importing pictures of LeRobot", "lerobot")
        self._half = 0.5 / fps
        self.shape = (sum(clip.count for clip in clips), *shape)
        self._pictures = itertools.chain.from_iterable(map(self._decode, clips))

    def read(self, start: int, count: int) -> Array:
        """Return the next `count` pictures, which begin at `start`."""
        found = list(itertools.islice(self._pictures, count))
        return np.stack(found) if found else np.empty((0, *self.shape[1:]), self.dtype)

    def _decode(self, clip: Clip) -> Iterator[Array]:
        """Yield the pictures of an episode."""
        left = clip.count
        try:
            with self._av.open(str(clip.path)) as file:
                stream = file.streams.video[0]
                file.seek(int(clip.start / stream.time_base), stream=stream)
                for frame in file.decode(stream):
                    if frame.time < clip.start - self._half:
                        continue
                    if not left:
                        return
                    left -= 1
                    yield _picture_of(str(clip.path), frame, self.shape[1:])
        except (self._av.FFmpegError, IndexError) as error:
            raise ExchangeError(f"{clip.path} cannot be read as a video: {error}.") from error
        if left:
            raise ExchangeError(f"{clip.path} lacks {left} pictures after {clip.start:g} s.")


def read_image(what: str, content: bytes, shape: Sequence[int]) -> Array:
    """Return the colors of a picture in a file such as PNG.

    Args:
        what: What has it, for messages.
        content: The file.
        shape: Height, width, and 3.
    """
    av = import_library("av", "Importing pictures of LeRobot", "lerobot")
    try:
        with av.open(io.BytesIO(content)) as file:
            frame = next(file.decode(video=0))
    except (av.FFmpegError, IndexError, StopIteration) as error:
        raise ExchangeError(f"{what} has what is no picture: {error}.") from error
    return _picture_of(what, frame, shape)


def _picture_of(what: str, frame: Any, shape: Sequence[int]) -> Array:
    """Return the colors of a decoded picture after checking its size."""
    if (frame.height, frame.width) != tuple(shape[:2]):
        raise ExchangeError(
            f"{what} has pictures of {frame.height} x {frame.width} pixels, not of "
            f"{shape[0]} x {shape[1]}."
        )
    picture: Array = frame.to_ndarray(format="rgb24")
    return picture
