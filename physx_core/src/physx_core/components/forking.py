"""Forking: copies of an environment that go on from where it is, in the same process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from physx_core.components.environment import Choose, Environment, Services
from physx_core.components.scene.event import Event
from physx_core.errors import UsageError
from physx_core.typing import Sample

E = TypeVar("E", bound=Environment)
_REMEMBERED = 1024
"""How many episodes a fork may lag behind."""


def fork(environment: E) -> E:
    """Return a copy: see `Environment.fork`."""
    state = environment.get_state()
    args, kwargs = environment._made_with
    copy: E = type(environment)(*args, **kwargs)
    copy.independent_episodes = environment.independent_episodes
    services, choose = environment._services, environment._choose_parameters
    if choose is not None and not isinstance(choose, SharedChoice):
        environment._choose_parameters = choose = SharedChoice(choose)
    aside = _Aside(services, environment._loaded)
    copy._services, copy._choose_parameters = aside, choose
    try:
        copy.create()
        copy.init()
        copy.init_database()
        copy.track_state()
        number = environment._saves_as
        if environment._has_kept and services is not None:
            aside.saved[number] = services.load_parameters(number)
        copy.set_state(state)
        copy.set_place(environment.get_place() | {"chosen": {}})
    except BaseException:
        copy.close()
        raise
    copy.compute_training_data, copy._sample = (
        environment.compute_training_data,
        environment._sample,
    )
    return copy


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

    def __call__(self, episode: int) -> Mapping[str, Any]:
        """Return the values of the parameters for an episode."""
        if episode not in self.chosen:
            self.chosen[episode] = self._choose(episode)
            self.chosen.pop(episode - _REMEMBERED, None)
        return self.chosen[episode]


class _Aside:
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
