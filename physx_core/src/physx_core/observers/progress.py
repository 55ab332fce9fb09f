"""ProgressBar: shows the progress of a run."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from physx_core.components.visualizer import Observer

_EPOCHS = "{desc}:{percentage:4.0f}%|{bar}| {remaining} left{postfix}"
_AMOUNT = "{desc}:{percentage:4.0f}%|{bar}| {n_fmt} of {total_fmt}{unit}, {remaining} left{postfix}"
_ENDLESS = "{desc}: {n_fmt}{unit} in {elapsed}, {rate_fmt}{postfix}"
_LOSSES = {"loss/training": "loss", "loss/validation": "validation"}


class ProgressBar(Observer):
    """A bar as wide as the terminal; otherwise, for logs, a line per minute and one at the end."""

    def __init__(self) -> None:
        self._bar: Any = None
        closed = sys.stderr is None or sys.stderr.closed
        self._stream = None if closed else sys.stderr
        self._is_terminal = self._stream is not None and self._stream.isatty()

    def begin(self, task: str, total: int | None, unit: str) -> None:
        """Start a bar."""
        from tqdm.auto import tqdm

        self.end()
        if self._stream is None:
            return
        interval = 0.1 if self._is_terminal else 60.0
        self._bar = tqdm(
            desc=task,
            total=total,
            unit=f" {unit}",
            bar_format=_ENDLESS if total is None else _EPOCHS if unit == "batches" else _AMOUNT,
            dynamic_ncols=self._is_terminal,
            mininterval=interval,
            maxinterval=interval,
            miniters=None if self._is_terminal else 0,
            delay=0 if self._is_terminal else 60.0,
            unit_scale=True,
            file=self._stream,
        )

    def advance(self, count: int) -> None:
        """Advance the bar."""
        if self._bar is not None:
            self._bar.update(count)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Show an epoch's number and losses after the bar.

        While environments generate, show their statistics instead.
        """
        if self._bar is None:
            return
        if timeline == "epoch":
            shown = {name: values[key] for key, name in _LOSSES.items() if key in values}
            shown = {"epoch": float(step), **shown}
        else:
            shown = {k[7:]: v for k, v in values.items() if k.startswith("online/")}
        if shown:
            self._bar.set_postfix_str(", ".join(f"{k} {v:.3g}" for k, v in shown.items()), False)

    def note(self, text: str) -> None:
        """Print the text above the bar."""
        from tqdm.auto import tqdm

        if self._stream is not None:
            tqdm.write(text, file=self._stream)

    def end(self) -> None:
        """Finish the bar and leave it visible."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def close(self) -> None:
        """Finish the bar and leave it visible."""
        self.end()
