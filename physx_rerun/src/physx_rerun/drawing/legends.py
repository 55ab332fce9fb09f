"""Legends of plots: shown where they leave the curves visible."""

from __future__ import annotations

import rerun.blueprint as rrb

_MOST = 3  # more would cover the curves of a small plot; the viewer names them under the mouse


def legend(curves: int) -> rrb.PlotLegend:
    """Return the legend of a plot with a number of curves; hidden if there are many."""
    return rrb.PlotLegend(rrb.Corner2D.RightTop, visible=curves <= _MOST)
