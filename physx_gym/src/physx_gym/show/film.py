"""Films of pictures, in formats that browsers and documents show by themselves."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, MissingLibraryError

SUFFIXES = (".gif", ".webp", ".png")


def write_film(pictures: Iterable[NDArray[np.uint8]], path: Path, frame_rate: float) -> Path:
    """Write pictures one after another as an animation that repeats itself.

    Args:
        pictures: Each of shape (height, width, 3); at least one.
        path: File to write; its suffix is one of `SUFFIXES`.
        frame_rate: Pictures a second; a ``.gif`` has at most 50.

    Returns:
        The path.

    Raises:
        ConfigError: The format is none of these.
        MissingLibraryError: Pillow is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"A film is a file {', '.join(SUFFIXES)}, not {path.name}. For other formats give the "
            "pictures of render() to a library such as imageio, or use gymnasium's RecordVideo."
        )
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingLibraryError("A film", "pillow", "film", "physx-gym") from error
    first, *rest = [Image.fromarray(picture) for picture in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    duration = round(1000 / frame_rate)
    first.save(path, save_all=True, append_images=rest, duration=duration, loop=0)
    return path
