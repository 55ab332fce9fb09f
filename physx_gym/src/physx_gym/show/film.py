"""Films in formats that browsers and documents can show."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, MissingLibraryError

SUFFIXES = (".gif", ".webp", ".png")


def write_film(pictures: Iterable[NDArray[np.uint8]], path: Path, frame_rate: float) -> Path:
    """Write pictures as a looping animation.

    Args:
        pictures: At least one, each of shape (height, width, 3).
        path: File to write; its suffix is one of `SUFFIXES`.
        frame_rate: Pictures per second; at most 50 in a ``.gif``.

    Returns:
        The path.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"The suffix of a film must be {', '.join(SUFFIXES)}, not {path.name}. For other "
            "formats pass the pictures of render() to a library such as imageio, or use "
            "gymnasium's RecordVideo."
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
