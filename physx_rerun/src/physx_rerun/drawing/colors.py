"""Converts the colors of scene objects to Rerun's numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from physx_core.errors import ConfigError, listed, nearest
from physx_core.typing import Array, Color

NAMES = {
    "black": "#000000",
    "blue": "#2f6fed",
    "brown": "#8b5a2b",
    "cyan": "#17becf",
    "gold": "#ffc83d",
    "gray": "#808080",
    "green": "#2ca02c",
    "grey": "#808080",
    "magenta": "#d33fd3",
    "navy": "#1f3a6e",
    "orange": "#ff7f0e",
    "pink": "#f39ac0",
    "purple": "#8e5bd0",
    "red": "#e03c31",
    "silver": "#c0c6cf",
    "skyblue": "#74b9f2",
    "teal": "#008080",
    "white": "#ffffff",
    "yellow": "#f5d63d",
}
"""Named colors, most a little softer than on the web, so that shading stays visible."""

COLORMAPS = {
    "viridis": ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"),
    "plasma": ("#0d0887", "#7e03a8", "#cc4778", "#f89540", "#f0f921"),
    "jet": ("#00007f", "#0000ff", "#00ffff", "#ffff00", "#ff0000", "#7f0000"),
    "coolwarm": ("#3b4cc0", "#9abbff", "#dddddd", "#f4987a", "#b40426"),
    "gray": ("#000000", "#ffffff"),
}
"""Colormaps as equidistant colors, interpolated linearly."""

CURVES = ("#4c9be8", "#ff9f43", "#2ecc71", "#ff6b6b", "#a78bfa", "#1dd1a1", "#feca57", "#f78fb3")
"""Colors of successive curves."""


def pack_rgba(rgba: Array) -> Array:
    """Pack colors into numbers 0xRRGGBBAA.

    Args:
        rgba: Red, green, blue and alpha in [0, 1], shape (..., 4).

    Returns:
        Colors, shape (...), unsigned 32 bit.
    """
    parts = np.round(np.clip(rgba, 0.0, 1.0) * 255.0).astype(np.uint32)
    return (parts << np.array([24, 16, 8, 0], np.uint32)).sum(axis=-1, dtype=np.uint32)


def parse_rgb(color: Color) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1].

    Args:
        color: A name of `NAMES`, ``#rrggbb``, or three numbers in [0, 1].
    """
    if not isinstance(color, str):
        return _from_numbers(color)
    text = NAMES.get(color.lower(), color)
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise ConfigError(
            f'"{color}" is not a color.{nearest(color, NAMES)} Give "#rrggbb", three numbers in '
            f"[0, 1], or a name: {listed(NAMES)}."
        )
    number = int(text[1:], 16)
    return (number >> 16) / 255, (number >> 8 & 255) / 255, (number & 255) / 255


def _from_numbers(color: Sequence[float]) -> tuple[float, float, float]:
    numbers = np.asarray(color)
    fits = numbers.shape == (3,) and numbers.dtype.kind in "fiu"
    if not fits or not ((numbers >= 0) & (numbers <= 1)).all():
        raise ConfigError(f"The color {color!r} is not red, green and blue in [0, 1].")
    red, green, blue = numbers.tolist()
    return red, green, blue


def rgba(color: Color, alpha: float = 1.0) -> Array:
    """Return one color as a number 0xRRGGBBAA, shape (1,)."""
    if not isinstance(alpha, (int, float, np.number)) or not 0 <= alpha <= 1:
        raise ConfigError(f"alpha is {alpha!r} but must be a number in [0, 1].")
    return pack_rgba(np.array([[*parse_rgb(color), alpha]]))


def map_values(values: Array, limits: tuple[float, float], colormap: str, alpha: float) -> Array:
    """Return the colors of values in a colormap.

    Args:
        values: Any numbers, shape (n,).
        limits: Values of the first and the last color.
        colormap: A name of `COLORMAPS`.
        alpha: Opacity in [0, 1].

    Returns:
        Colors 0xRRGGBBAA, shape (n,).
    """
    if colormap not in COLORMAPS:
        raise ConfigError(
            f'There is no colormap "{colormap}".{nearest(colormap, COLORMAPS)} '
            f"Colormaps: {listed(COLORMAPS)}."
        )
    low, high = limits
    anchors = np.array([parse_rgb(color) for color in COLORMAPS[colormap]])
    place = (np.nan_to_num(values) - low) / max(high - low, 1e-12) * (len(anchors) - 1)
    ticks = np.arange(len(anchors))
    channels = [np.interp(place, ticks, anchors[:, channel]) for channel in range(3)]
    return pack_rgba(np.stack([*channels, np.full(len(values), alpha)], axis=-1))


def curves(count: int, shift: int = 0) -> Array:
    """Return colors 0xRRGGBBAA for curves of one plot, shape (count,).

    Args:
        count: Number of curves.
        shift: Number of curves that the plot already has.
    """
    chosen = [CURVES[(shift + number) % len(CURVES)] for number in range(count)]
    return np.array([rgba(color)[0] for color in chosen], np.uint32)
