"""The hook that returns materials, a kind of component that only this package knows."""

from physx_core.plugins import kind_hook


@kind_hook("physx_workshop.materials:Material")
def physx_materials():
    """Return subclasses of `Material` by name."""
