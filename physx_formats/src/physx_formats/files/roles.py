"""Roles: which fields are the observations, actions and rewards of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from physx_core.errors import ConfigError, listed, nearest
from physx_formats.table import ExportOptions, Table

OBSERVATION = "observation."
"""Beginning of the names of features that are observations."""


@dataclass(frozen=True)
class Roles:
    """The roles of a mode's fields in an episode; the other fields are its infos.

    Attributes:
        observations: One field that is the observation itself, or several that are its entries.
        actions: Likewise for the actions; none: there is only one action, which does nothing.
        rewards: Field that is the reward, a single number; None: the reward is 0.
        entries: Whether the observation is a dictionary even if it has only one field.
    """

    observations: Sequence[str]
    actions: Sequence[str]
    rewards: str | None
    entries: bool

    @classmethod
    def choose(cls, table: Table, options: ExportOptions) -> Roles:
        """Complete the user's choice."""
        observations, actions, rewards = options.observations, options.actions, options.rewards
        named = [name for fields in options.features.values() for name in fields]
        chosen = [*observations, *actions, *([] if rewards is None else [rewards]), *named]
        for name in chosen:
            if name not in table.fields:
                raise ConfigError(
                    f'Mode "{table.mode}" has no field "{name}".{nearest(name, table.fields)} '
                    f"Fields: {listed(table.fields)}."
                )
            if chosen.count(name) > 1:
                raise ConfigError(f'The field "{name}" is chosen more than once.')
        if rewards is not None and table.fields[rewards].shape != ():
            raise ConfigError(f'The reward "{rewards}" is not a single number.')
        if any(name.startswith(OBSERVATION) for name in options.features):
            return cls(observations, actions, rewards, entries=True)
        rest = [n for n, f in table.fields.items() if f.role == "training" and n not in chosen]
        if not observations and not rest:
            raise ConfigError("No field is left for the observations.")
        return cls(observations or rest, actions, rewards, not observations)
