"""``physx robots``: list the robots that are available by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from physx_core import PhysxError, plugins
from physx_core.cli import show, show_table
from physx_core.errors import UsageError
from physx_core.origin import install_hint
from physx_sim import RobotInfo

_HELP = """usage: physx robots

Lists the robots that can be given by name, as in Robot("cartpole"), with the
degrees of freedom of their joints (a floating base has 6 more), their mass,
and the kind of their collision shapes. With meshes, Robot(collisions="boxes")
or "capsules" is many times faster."""


def run(words: Sequence[str]) -> None:
    """Print each robot that an installed backend knows by name."""
    if words and words[0] in ("-h", "--help"):
        print(_HELP)
        return
    if words:
        raise UsageError(f"physx robots takes no arguments but got {' '.join(words)}.")
    robots = {info.path: info for info in _robots()}
    if not robots:
        print(f"No installed backend knows robots by name. {install_hint('physx-dart')}")
        return
    _print_table(list(robots.values()))


def _robots() -> Iterator[RobotInfo]:
    """Return the robots of all backends; print the error of a broken backend."""
    for name in plugins.available():
        try:
            backends = plugins.load(name).components.get("backend", {})
            for key in backends:
                yield from plugins.resolve("backend", f"{name}/{key}").robots()
        except PhysxError as error:
            show(f"{name}  broken: {error}")


def _print_table(robots: Sequence[RobotInfo]) -> None:
    rows = []
    for info in robots:
        if info.error:
            reason = info.error.splitlines()[0].rstrip(":")
            rows.append([info.name, "", "", "", f"cannot be loaded: {reason}"])
        else:
            figures = [str(info.joints), f"{info.mass:.4g}"]
            rows.append([info.name, *figures, info.collisions, "; ".join(info.warnings)])
    numbers = ("dof", "mass [kg]")
    show_table(["name", *numbers, "collisions", ""], rows, numbers=numbers)
    if any(text.startswith("slow:") for info in robots for text in info.warnings):
        show('slow: Robot(collisions="boxes") or "capsules" replaces meshes by bounding shapes')
