"""ProgressBar: shows the progress of a run."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from physx_core.components.visualizer import Observer


class ProgressBar(Observer):
    """A bar on a terminal; otherwise, for logs, one line per minute and one at the end."""

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
        """Show an epoch's statistics after the bar, except those over several epochs.

        While environments generate, show their statistics instead.
        """
        if self._bar is None:
            return
        if timeline == "epoch":
            shown = {k: v for k, v in values.items() if not k.endswith(("_mean", "_variance"))}
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
