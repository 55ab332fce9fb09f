"""Services: what environments may request from their run, and forks of them share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self, TypeAlias

from physx_core.components.scene.event import Event
from physx_core.errors import UsageError
from physx_core.typing import Sample

_REMEMBERED = 1024
"""How many episodes a fork may lag behind."""


class Services(Protocol):
    """Requests that an environment can make to its run."""

    def predict(self, fields: Sample) -> Sample:
        """Return the network's prediction for one sample, in physical units."""
        ...

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does to an instance: see `Observer.touch`."""
        ...

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Save values of one instance, or of all (0), for later runs on the same dataset."""
        ...

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that one instance, or 0, saved; empty if it saved none."""
        ...

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Pass drawing events to the viewers."""
        ...


Choose: TypeAlias = Callable[[int], Mapping[str, Any]]
"""Returns the values of the parameters for an episode, by name."""


class SharedChoice:
    """Parameters of an environment and its forks, which the run is asked for once.

    Attributes:
        chosen: The last ones by episode.
    """

    def __init__(
        self, choose: Choose, chosen: Mapping[int, Mapping[str, Any]] | None = None
    ) -> None:
        """Share what a function chooses, beginning with what is known."""
        self._choose = choose
        self.chosen = dict(chosen or {})

    @classmethod
    def of(cls, choose: Choose) -> Self:
        """Return a function that is shared from now on, if it is not yet."""
        return choose if isinstance(choose, cls) else cls(choose)

    def __call__(self, episode: int) -> Mapping[str, Any]:
        """Return the values of the parameters for an episode."""
        if episode not in self.chosen:
            self.chosen[episode] = self._choose(episode)
            self.chosen.pop(episode - _REMEMBERED, None)
        return self.chosen[episode]


class Aside:
    """The services of a fork: it asks the same network, and keeps what it saves.

    Attributes:
        saved: What it, or the environment before, has saved, by instance.
    """

    def __init__(self, services: Services | None, loaded: list[dict[str, Any]]) -> None:
        """Answer with these parameters while the fork is created, as when its origin was."""
        self._services, self._loaded = services, list(loaded)
        self.saved: dict[int, dict[str, Any]] = {}

    def predict(self, fields: Sample) -> Sample:
        """Return the prediction of the run's network."""
        if self._services is None:
            raise UsageError("This environment is not part of a run yet.")
        return self._services.predict(fields)

    def touch(self, instance_id: int) -> Sequence[float]:
        """Do nothing."""
        return ()

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep values."""
        self.saved[instance_id] = {**self.saved.get(instance_id, {}), **values}

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return what was saved."""
        if self._loaded:
            return self._loaded.pop(0)
        return dict(self.saved.get(instance_id, {}))

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Draw nothing."""
