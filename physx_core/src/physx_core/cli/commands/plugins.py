"""``physx plugins``: list the installed plugins, their components, and those that are broken."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core import plugins
from physx_core.errors import PhysxError, UsageError


def run(words: Sequence[str]) -> None:
    """Print each plugin with its components, or with the reason why it is broken."""
    if words and words[0] in ("-h", "--help"):
        print("usage: physx plugins\n\nLists the plugins, and loads each to list its components.")
        return
    if words:
        raise UsageError(f"physx plugins takes no options, not {' '.join(words)}.")
    for name, info in plugins.available().items():
        print(f"{name}  ({', '.join(info.distributions)})")
        try:
            plugin = plugins.load(name)
        except PhysxError as error:
            print(f"  broken: {error}")
            continue
        for kind, components in plugin.components.items():
            print(f"  {kind}: {', '.join(f'{name}/{key}' for key in components)}")
