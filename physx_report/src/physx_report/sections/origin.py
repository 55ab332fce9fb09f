"""The section on what a run was made from, and how to repeat it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

from physx_report import wording
from physx_report.blocks import Block, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_COMMANDS = {"data_generation": "generate", "training": "train", "prediction": "predict"}


def _blocks(run: Run) -> Iterator[Block]:
    for kind, result in run.results.items():
        places = [list(each) for each in result.places.items()]
        if places:
            yield Table(["", ""], places, f"Places ({kind})")
    for kind, options in run.config.items():
        rows = [list(each) for each in wording.flat(options).items() if each[0] != "new_session"]
        yield Table(["option", "value"], rows, f"Options ({kind})")
        if kind in _COMMANDS:
            file = shlex.quote(str(Path(run.path) / "config.toml"))
            again = f"physx {_COMMANDS[kind]} --config {file}"
            goes_on = kind == "prediction"  # with the session's network
            yield Text([again if goes_on else f"{again} --session-name again"], "code")
    if "sweep" in run.results:
        study = run.path / "study.toml"
        if study.is_file():
            yield Text(study.read_text(errors="replace").splitlines(), "code")
        yield Text([f"physx sweep {shlex.quote(str(study))} --study again"], "code")
    info = run.path / "info.txt"
    lines = info.read_text(errors="replace").splitlines() if info.is_file() else []
    versions = [line for line in lines if "physx-core " in line and ", " in line]
    if versions:
        yield Text([f"Versions: {versions[-1]}."])


SECTION = Section("Made from", _blocks, 90)
