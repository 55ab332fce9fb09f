"""The errors of worlds and engines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from physx_core.errors import PhysxError, listed


class ModelError(PhysxError):
    """A robot or world description cannot be loaded."""


class MissingMeshesError(ModelError):
    """A robot description names mesh files of collision shapes that do not exist.

    Attributes:
        missing: All missing files, as named in the description.
    """

    def __init__(self, model: str, missing: Sequence[str]) -> None:
        self.missing = list(missing)
        lines = "".join(f"\n  {name}" for name in self.missing)
        super().__init__(
            f"{model} names {len(self.missing)} mesh file(s) that do not exist:{lines}\n"
            "They were looked for in the packages among the folders around this file, beside them, "
            "and in these folders. Give the folder of each package in "
            'Robot(package_dirs={name: folder}), or do without shapes: Robot(collisions="none").'
        )


class SimulationError(PhysxError):
    """A simulation cannot perform a call, or its state is no longer finite."""


class FeatureNotSupportedError(SimulationError):
    """The engine does not have the requested feature.

    Attributes:
        engine: Name of the engine.
        feature: The requested feature.
        features: The engine's features.
    """

    def __init__(
        self, engine: str, feature: str, features: Iterable[str], advice: str = ""
    ) -> None:
        self.engine, self.feature, self.features = engine, feature, sorted(features)
        super().__init__(
            f'{engine} does not have the feature "{feature}".{advice and " " + advice} '
            f"It has: {listed(self.features)}."
        )
