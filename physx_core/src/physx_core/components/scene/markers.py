"""Markers: symbols on vertices of meshes, which move and turn with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from physx_core.components.scene.event import Event
from physx_core.components.scene.geometry import vertex_normals
from physx_core.errors import ConfigError, listed
from physx_core.typing import Array


@dataclass(frozen=True, slots=True)
class _Mesh:
    """A mesh that can have markers.

    Attributes:
        positions: Its vertices.
        cells: Its triangles.
        indices: The marked vertices, by the markers' names.
    """

    positions: Array
    cells: Array
    indices: Mapping[str, Array] = field(default_factory=dict)

    def places(self, indices: Array) -> dict[str, Any]:
        """Return positions and normals of vertices."""
        around = self.cells[np.isin(self.cells, indices).any(axis=1)]
        normals = vertex_normals(self.positions, around)
        return {"positions": self.positions[indices], "orientations": normals[indices]}


class MarkedMeshes:
    """The meshes of a scene, and the markers on them."""

    def __init__(self, meshes: Mapping[str, _Mesh] | None = None) -> None:
        self._meshes = dict(meshes or {})

    def copy(self) -> MarkedMeshes:
        """Return an independent copy."""
        return MarkedMeshes(self._meshes)

    def add(self, name: str, positions: Array, cells: Array) -> None:
        """Add a mesh without markers."""
        self._meshes[name] = _Mesh(positions, cells)

    def change(self, name: str, changes: Mapping[str, Any]) -> list[Event]:
        """Change a mesh, and return the moves of its markers.

        Raises:
            ConfigError: If it loses marked vertices.
        """
        parts = {part: changes[part] for part in ("positions", "cells") if part in changes}
        if not parts:
            return []
        mesh = dataclasses.replace(self._meshes[name], **parts)
        for markers, indices in mesh.indices.items():
            if len(indices) and indices.max() >= len(mesh.positions):
                raise ConfigError(
                    f'Object "{name}": positions has {len(mesh.positions)} vertices, but the '
                    f'markers "{markers}" are on vertex {indices.max()}. Change their indices '
                    "first, or remove them."
                )
        self._meshes[name] = mesh
        return [
            Event("update", "symbols", (markers,), mesh.places(indices))
            for markers, indices in mesh.indices.items()
        ]

    def mark(self, name: str, changes: dict[str, Any]) -> dict[str, Any]:
        """Add or change markers, and return their changes as those of symbols on the vertices.

        Raises:
            ConfigError: If there is no such mesh, or it has no such vertices.
        """
        if "mesh" in changes:
            chosen = changes.pop("mesh")
            if chosen not in self._meshes:
                raise ConfigError(
                    f'Object "{name}": there is no mesh "{chosen}" to mark. '
                    f"Meshes: {listed(self._meshes)}."
                )
        else:
            chosen = next(each for each, mesh in self._meshes.items() if name in mesh.indices)
        if "indices" in changes:
            mesh, indices = self._meshes[chosen], changes.pop("indices")
            if len(indices) and not 0 <= indices.min() <= indices.max() < len(mesh.positions):
                raise ConfigError(
                    f'Object "{name}": indices goes from {indices.min()} to {indices.max()}, but '
                    f'the mesh "{chosen}" has the vertices 0 to {len(mesh.positions) - 1}.'
                )
            changes |= mesh.places(indices)
            marked = {**mesh.indices, name: indices}
            self._meshes[chosen] = dataclasses.replace(mesh, indices=marked)
        return changes

    def remove(self, name: str) -> tuple[str, ...]:
        """Remove a mesh or markers, if it is one of them; return the markers that a mesh had."""
        mesh = self._meshes.pop(name, None)
        if mesh is not None:
            return tuple(mesh.indices)
        for each, mesh in self._meshes.items():
            if name in mesh.indices:
                others = {marks: mesh.indices[marks] for marks in mesh.indices if marks != name}
                self._meshes[each] = dataclasses.replace(mesh, indices=others)
                break
        return ()
