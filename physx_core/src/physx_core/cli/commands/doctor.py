"""``physx doctor``: show what a bug report needs: versions, drivers, disk, limits, problems."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from physx_core.cli import installation
from physx_core.cli.commands.plugins import load_all
from physx_core.cli.output import show, show_values
from physx_core.errors import UsageError

_HELP = """usage: physx doctor

Shows what a bug report needs, without secrets: the interpreter, the machine,
drivers, graphics cards, how fast this folder's disk is, limits, where each
package comes from, broken plugins, and packages that hide others."""


def run(words: Sequence[str]) -> None:
    """Print what is installed and what the machine offers."""
    if words and words[0] in ("-h", "--help"):
        print(_HELP)
        return
    if words:
        raise UsageError(f"physx doctor takes no options, not {' '.join(words)}.")
    packages = installation.find_packages()
    for title, values in (
        ("machine", installation.describe_machine()),
        ("drivers", installation.describe_drivers(os.environ)),
        ("this folder", installation.describe_disk(Path())),
        ("limits", installation.describe_limits()),
        ("environment variables", installation.describe_variables(os.environ)),
    ):
        show(title if values else f"{title}: none relevant")
        show_values(values)
    show("packages")
    places: dict[str, list[str]] = {}
    for each in packages:
        places.setdefault(each.place, []).append(f"{each.name} {each.version}")
    for place, names in places.items():
        show(f"  {place}: {', '.join(names)}")
    problems = [f"{each.name}: {text}" for each in packages for text in each.problems]
    show(f"conflicts: {'' if problems else 'none'}")
    for text in problems:
        show(f"  {text}")
    show("plugins")
    for _ in load_all():
        pass
