"""Converts the colors of scene objects to Rerun's integers."""

from __future__ import annotations

import numpy as np

from physx_core.components import map_values as map_rgb
from physx_core.components import parse_color
from physx_core.typing import Array, Color

CURVES = ("#4c9be8", "#ff9f43", "#2ecc71", "#ff6b6b", "#a78bfa", "#1dd1a1", "#feca57", "#f78fb3")
"""Colors of successive curves."""


def rgba(color: Color, alpha: float = 1.0) -> Array:
    """Return one color as an integer 0xRRGGBBAA, shape (1,), unsigned 32 bit."""
    return pack_rgba(np.array([[*parse_color(color), alpha]]))


def pack_rgba(rgba: Array) -> Array:
    """Pack colors into integers 0xRRGGBBAA.

    Args:
        rgba: Red, green, blue and alpha in [0, 1], shape (..., 4).

    Returns:
        Colors, shape (...), unsigned 32 bit.
    """
    return _packed(np.round(np.clip(rgba, 0.0, 1.0) * 255.0))


def _packed(parts: Array) -> Array:
    red, green, blue, alpha = np.moveaxis(parts.astype(np.uint32), -1, 0)
    packed: Array = red << 24 | green << 16 | blue << 8 | alpha
    return packed


def map_values(values: Array, limits: tuple[float, float], colormap: str, alpha: float) -> Array:
    """Return the colors of values in a colormap.

    Args:
        values: Any numbers, shape (n,).
        limits: Values of the first and last color.
        colormap: Name of a Matplotlib colormap.
        alpha: Opacity in [0, 1].

    Returns:
        Colors 0xRRGGBBAA, shape (n,), unsigned 32 bit.
    """
    parts = map_rgb(values, *limits, colormap)
    opacity = np.full((*parts.shape[:-1], 1), round(255 * alpha), np.uint8)
    return _packed(np.concatenate([parts, opacity], axis=-1))


def curves(count: int, shift: int = 0) -> Array:
    """Return colors 0xRRGGBBAA for curves of one plot, shape (count,).

    Args:
        count: Number of curves.
        shift: Number of curves that the plot already has.
    """
    chosen = [CURVES[(shift + number) % len(CURVES)] for number in range(count)]
    return np.array([rgba(color)[0] for color in chosen], np.uint32)
