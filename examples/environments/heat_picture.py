"""A picture of where simulations were made and where the errors are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from environments.heat import Heat


def draw(
    path: Path, found: Sequence[tuple[str, Sequence[np.ndarray], np.ndarray]], given: np.ndarray
) -> None:
    """Draw width and diffusivity of the simulations, and the errors over them.

    Args:
        path: The picture.
        found: For each sampler: its name, widths and diffusivities of the simulations, and errors.
        given: The inputs that the errors belong to, shape (rows, 5), scaled to -1..1.
    """
    low, high = np.array([[each.low[0], each.high[0]] for each in Heat.PARAMETERS[2:]]).T
    places = (low + (given[:, 2:4] + 1) / 2 * (high - low)).T
    shape = {"sharex": True, "sharey": True, "figsize": (8, 6), "layout": "constrained"}
    figure, panels = plt.subplots(2, 2, **shape)
    for (above, below), (name, sets, error) in zip(panels.T, found, strict=True):
        above.scatter(*sets, s=3)
        above.set_title(f"{name}: simulations")
        order = np.argsort(error)  # the largest on top
        colors = {"c": error[order], "vmin": 0, "vmax": found[0][2].max() / 2, "cmap": "viridis_r"}
        shown = below.scatter(*places[:, order], s=6, **colors)
        below.set(title="errors on unseen ones", xlabel="width of the spot (m)")
    figure.supylabel("diffusivity (m²/s)")
    figure.colorbar(shown, ax=panels[1], label="relative error")
    figure.savefig(path, dpi=80)
