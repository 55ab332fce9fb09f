"""``physx plugins``: list the installed plugins, their components, and broken plugins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from physx_core import plugins
from physx_core.cli.output import show
from physx_core.errors import PhysxError, UsageError, printable
from physx_core.plugins import Plugin
from physx_core.plugins.entries import find_unreadable


def run(words: Sequence[str]) -> None:
    """Print each plugin with its components, or the reason why it is broken."""
    if words and words[0] in ("-h", "--help"):
        print("usage: physx plugins\n\nLists the plugins and loads each to list its components.")
        return
    if words:
        raise UsageError(f"physx plugins takes no options, not {' '.join(words)}.")
    for name, plugin in load_all():
        for kind, components in plugin.components.items():
            show(f"  {kind}: {', '.join(f'{name}/{key}' for key in components)}")


def load_all() -> Iterator[tuple[str, Plugin]]:
    """Load each plugin and yield it; print its name first, and its error if it is broken."""
    for name, info in plugins.available().items():
        # Flush: if the plugin crashes or hangs, this line shows which one it was.
        print(printable(f"{name}  ({', '.join(info.distributions)})"), flush=True)
        try:
            plugin = plugins.load(name)
        except PhysxError as error:
            show(f"  broken: {error}")
            continue
        yield name, plugin
    for package, problem in find_unreadable().items():
        show(f"The entry points of the package {package} cannot be read: {problem}")
