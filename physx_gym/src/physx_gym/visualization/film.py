"""Films in formats that browsers and documents can show."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, MissingLibraryError

SUFFIXES = (".mp4", ".gif", ".webp", ".png")

Picture = NDArray[np.uint8]


def write_film(pictures: Iterable[Picture], path: Path, frame_rate: float) -> Path:
    """Write pictures as a film; all but ``.mp4`` are looping animations.

    Each picture is rendered while the previous one is written.

    Args:
        pictures: At least one, each of shape (height, width, 3).
        path: File to write; its suffix is one of `SUFFIXES`.
        frame_rate: Pictures per second; at most 50 in a ``.gif``.

    Returns:
        The path.

    Raises:
        ConfigError: If the suffix is another one.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(
            f"The suffix of a film must be {', '.join(SUFFIXES)}, not {path.name}. For other "
            "formats pass the pictures of render() to a library such as imageio, or use "
            "gymnasium's RecordVideo."
        )
    write = _write_mp4 if suffix == ".mp4" else _write_animation
    path.parent.mkdir(parents=True, exist_ok=True)
    write(_ahead(iter(pictures)), path, frame_rate)
    return path


def _ahead(pictures: Iterator[Picture]) -> Iterator[Picture]:
    """Yield pictures, each while a thread renders the next."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, pictures, None)
        while (picture := coming.result()) is not None:
            coming = thread.submit(next, pictures, None)
            yield picture


def _write_animation(pictures: Iterator[Picture], path: Path, frame_rate: float) -> None:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingLibraryError("A film", "pillow", "film", "physx-gym") from error
    first, *rest = [Image.fromarray(picture) for picture in pictures]
    duration = round(1000 / frame_rate)
    first.save(path, save_all=True, append_images=rest, duration=duration, loop=0)


def _write_mp4(pictures: Iterator[Picture], path: Path, frame_rate: float) -> None:
    try:
        import av
    except ImportError as error:
        raise MissingLibraryError("A film as .mp4", "av", "film", "physx-gym") from error
    first = next(pictures)
    high, wide = (size - size % 2 for size in first.shape[:2])  # odd sizes are not supported
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=Fraction(frame_rate).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = wide, high, "yuv420p"
        for picture in itertools.chain([first], pictures):
            cut = np.ascontiguousarray(picture[:high, :wide])
            file.mux(stream.encode(av.VideoFrame.from_ndarray(cut, format="rgb24")))
        file.mux(stream.encode())
