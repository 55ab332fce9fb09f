"""``physx sweep``: try pipelines with many settings and seeds: locally, on Ray, or on Slurm."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from physx_core.cli import options_from, show
from physx_core.errors import UsageError, printable
from physx_core.terminal import wrapped


@dataclass
class Sweep:
    """Try pipelines with many settings and seeds.

    The same command resumes a sweep that was killed; the results are the same.

    physx sweep sweep.toml --parallel 4

    physx sweep studies/sweep --status

    physx sweep studies/sweep --view --figure sweep.png
    """

    place: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE.toml|STUDY")]
    """The file that describes the study, or the study's folder."""
    study: Path | None = None
    """Folder of the study; by default studies/NAME, where NAME is the file's name."""
    executor: str | None = None
    """Where trials run: "local", "ray", or "slurm"; by default as in the file."""
    parallel: int | None = None
    """Number of concurrent trials; by default as in the file."""
    status: bool = False
    """Print the study's trials as a table, without running any."""
    view: bool = False
    """Put the curves of all trials into one recording, without running any."""
    visualizer: str = "rerun"
    """Visualizer for the curves of --view."""
    figure: Path | None = None
    """Draw the results into this file (.png, .svg, .pdf), without running any trials."""


def run(words: Sequence[str]) -> None:
    """Run or show the study."""
    from physx_cluster.sweep.definition import Definition
    from physx_cluster.sweep.runner import run_study
    from physx_cluster.sweep.study import STUDY, Study, is_study

    options = options_from(Sweep, words, "sweep")
    folder = options.study or Path("studies") / options.place.stem
    file = options.place
    if file.is_dir() or is_study(file):
        if options.study is not None:
            raise UsageError("--study names the folder of a new study; this one already exists.")
        folder, file = file, file / STUDY
        Study.read(folder)
    if options.status or options.view or options.figure is not None:
        _show(Study.read(folder), options)
        return
    given: dict[str, Any] = {"executor": options.executor, "parallel": options.parallel}
    chosen = {name: value for name, value in given.items() if value is not None}
    definition = Definition.read(file, folder.resolve().name, **chosen)
    try:
        study = run_study(definition, folder, _say)
    except KeyboardInterrupt as error:
        error.add_note("the same command resumes it")
        raise
    _report(study, folder)


def _show(study: Any, options: Sweep) -> None:
    from physx_cluster.sweep.show import draw_figure, record_curves, show_status

    if options.status:
        show_status(study)
    if options.view:
        for line in record_curves(study, options.visualizer):
            show(line)
    if options.figure is not None:
        draw_figure(study, options.figure)
        show(f"figure: {options.figure}")


def _report(study: Any, folder: Path) -> None:
    from physx_cluster.errors import StudyError
    from physx_cluster.sweep.show import summary
    from physx_cluster.sweep.study import TABLE

    for line in summary(study):
        _say(line)
    _say(f"table: {folder / TABLE}")
    place = shlex.quote(str(folder))
    _say(f"next: physx sweep {place} --status")
    _say(f"next: physx report {place}")
    if study.best() is None:
        raise StudyError(
            f"No trial of {folder} is complete with all seeds. The end of each trial's output.txt "
            "shows why it ended."
        )


def _say(line: str) -> None:
    print(wrapped(printable(line)), file=sys.stderr, flush=True)
