"""Diagnosis: why two engines part, cause by cause; what is blamed is taken away to confirm it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np

from physx_agree import models, probes
from physx_agree.causes import Cause, Parting
from physx_agree.episodes import Episode, record
from physx_agree.laboratory import Laboratory, Moment
from physx_agree.models import Held
from physx_agree.parting import (
    LIMIT,
    TEXTS,
    UNEXPLAINED,
    Anatomy,
    Floor,
    gap_between,
    norms,
)
from physx_agree.readings import (
    Difference,
    above_the_engine,
    differences,
    flat,
    give,
    limits,
)
from physx_core.errors import ConfigError, PhysxError
from physx_core.typing import Vector
from physx_sim import World

_DISSECTED = 24
"""Largest number of steps that are looked at one by one."""
_EQUAL, _AWAY = 1e-9, 1e-6
"""Differences of commands that count as none, and of positions that count as some."""
_BEGINNING = 200
"""How many physics steps of an episode show what lies above the engine."""
_MOVED = 0.5
"""Which part of a difference may remain when its cause is taken away."""
_HELPS = 0.2
"""Which part of a step's difference a cause must make to count."""

Make = Callable[[Any], gymnasium.Env[Any, Any]]
"""Makes the task on an engine."""
Named = tuple[Any, str]
"""Reference of an engine, and its name."""


class Diagnosis:
    """Finds out why two engines part in an episode."""

    def __init__(
        self, make: Make, engines: tuple[Named, Named], episode: Episode, seed: int
    ) -> None:
        """Prepare; nothing is simulated.

        Args:
            make: Makes the task on an engine.
            engines: References of the engines, with their names.
            episode: The task's episode on the first of them.
            seed: Of the episode.
        """
        self._make, self._episode, self._seed = make, episode, seed
        self._engines = tuple(reference for reference, _ in engines)
        self._names = engines[0][1], engines[1][1]
        self._causes: list[Cause] = []
        self._unconfirmed: list[str] = []
        self._at_first: dict[str, float] = {}
        self._after: dict[Laboratory, Vector] = {}
        self._first: int | None = None

    def parting(self) -> Parting:
        """Compare the engines, and look for causes."""
        replayed = self._above()
        episode = self._episode
        one = Laboratory(self._engines[0], episode.world, episode.first)
        other = Laboratory(self._engines[1], replayed.world, episode.first)
        self._labs, self._opened = (one, other), [one, other]
        try:
            _check_layouts(*self._labs)
            self._floor = Floor.of(one, episode)
            self._moments: Sequence[Moment] = episode.moments
            self._apart = apart = self._measure()
            parted = np.flatnonzero(apart > self._floor.bound)
            self._first = int(parted[0]) if len(parted) else None
            self._total = float(apart[parted].sum()) or 1.0
            self._explain(replayed.world)
            left = self._dissect()
        finally:
            for lab in self._opened:
                lab.close()
        away, growth = _trajectories(episode, replayed)
        if self._first is None and away is not None and not self._causes:
            text = "the same steps; what differs by rounding grows"
            self._causes.append(Cause("sensitivity", text, 0.0, "no step from equal states parts"))
        return Parting(
            self._names,
            self._seed,
            len(episode.moments),
            one.simulation.period,
            len(parted),
            self._first,
            max(self._at_first, key=lambda kind: self._at_first[kind], default=""),
            _median_and_largest(apart),
            _median_and_largest(self._floor.floor),
            tuple(sorted(self._causes, key=lambda cause: -cause.share)),
            tuple(self._unconfirmed),
            left,
            away,
            growth,
        )

    # Above the engine -----------------------------------------------------------------------

    def _above(self) -> Episode:
        """Compare what lies between policy and engine; return the episode on the second engine."""
        first, second = (self._make(engine) for engine in self._engines)
        found = differences(above_the_engine(first), above_the_engine(second))
        first.close()
        replayed = self._replay(second)
        gap, kept = _commands_apart(self._episode, replayed), list[Difference]()
        for difference in found:
            changed = self._given([*kept, difference]) if gap > 0.0 else None
            less = np.inf if changed is None else _commands_apart(self._episode, changed)
            if less > _MOVED * gap:
                self._unconfirmed.append(str(difference))
                continue
            told = f"{100 * less / gap:.2g} % as far apart" if less else "equal"
            text = f"given to {self._names[1]}, the commands to the joints are {told}"
            self._causes.append(Cause("above the engine", str(difference), 0.0, text))
            kept.append(difference)
            gap = less
        return replayed

    def _replay(self, env: gymnasium.Env[Any, Any]) -> Episode:
        try:
            return record(env, self._episode.actions, self._seed, len(self._episode.moments))
        finally:
            env.close()

    def _given(self, given: Iterable[Difference]) -> Episode | None:
        """Return the episode on the second engine, with settings of the first."""
        env: gymnasium.Env[Any, Any] | None = self._make(self._engines[1])
        for difference in given:
            env = None if env is None else give(env, difference)
        if env is None:
            return None
        try:
            return self._replay(env)
        except PhysxError:
            return None

    # What the engines hold ------------------------------------------------------------------

    def _explain(self, second: World) -> None:
        self._compare_worlds(second)
        self._compare_torque_limits()
        world = self._labs[0].world
        for read in (models.mass_differences, models.force_differences):
            one, other = (lab.simulation for lab in self._labs)
            for held in read(one, other, world):
                self._repair(held, self._smooth_moves)
        for probe in (probes.restitution_differences, probes.friction_differences):
            for held in probe(*self._labs):
                self._repair(held, self._probe_moves(probe, held))

    def _compare_worlds(self, second: World) -> None:
        """Give the second engine the first one's description, field by field."""
        first = self._labs[0].world
        for field in dataclasses.fields(World):
            values = getattr(first, field.name), getattr(second, field.name)
            found = differences(*(flat(value, f"world.{field.name}") for value in values))
            if found:
                text = "; ".join(map(str, found))
                held = Held("description", text, _same(field.name))
                self._repair(held, lambda before: "")

    def _compare_torque_limits(self) -> None:
        layouts = [lab.simulation.layout for lab in self._labs]
        found = differences(*map(limits, layouts))
        torques = [each for each in found if each.where.endswith("max_torque")]
        if torques:
            most = np.minimum(layouts[0].max_torque, layouts[1].max_torque)
            self._moments = [
                each.but(commands=np.clip(each.commands, -most, most)) for each in self._moments
            ]
            self._after.clear()
            text = "; ".join(map(str, torques))
            self._settle(Held("torque limit", text), "")
        self._limits = [str(each) for each in found if each not in torques]

    def _repair(self, held: Held, moves: Callable[[tuple[Laboratory, ...]], str]) -> None:
        """Take a difference away; keep it as a cause if anything moves.

        Args:
            held: The difference.
            moves: Says what has moved apart from the steps, given the laboratories before; empty:
                nothing.
        """
        before = self._labs
        if held.repair is None or not self._swap(held.repair):
            self._unconfirmed.append(held.text)
            return
        self._settle(held, moves(before), undo=before)

    def _swap(self, repair: models.Repair) -> bool:
        worlds = repair(*(lab.world for lab in self._labs))
        labs = []
        try:
            for lab, world in zip(self._labs, worlds, strict=True):
                labs.append(lab if world is lab.world else lab.with_world(world))
        except PhysxError:
            return False
        finally:
            self._opened += [lab for lab in labs if lab not in self._opened]
        self._labs = labs[0], labs[1]
        return True

    def _settle(
        self, held: Held, moved: str, undo: tuple[Laboratory, Laboratory] | None = None
    ) -> None:
        """Name a cause if the steps move, or something else has moved; else undo its repair."""
        before, now = self._apart, self._measure()
        parted = before > self._floor.bound
        less = int((parted & (now < _MOVED * before)).sum())
        if not (moved or less):
            self._unconfirmed.append(held.text)
            self._labs = undo or self._labs
            return
        steps = f"{less} of {int(parted.sum())} steps part less" if less else ""
        self._add(held.kind, held.text, before, now, ", ".join(filter(None, (moved, steps))))
        self._apart = now

    def _add(self, kind: str, text: str, before: Vector, now: Vector, confirmed: str) -> None:
        parted = before > self._floor.bound
        share = max(0.0, float((before - now)[parted].sum())) / self._total
        self._causes.append(Cause(kind, text, share, confirmed))
        if self._first is not None:
            self._at_first[kind] = float(before[self._first] - now[self._first])

    def _smooth_moves(self, before: tuple[Laboratory, ...]) -> str:
        """Say that accelerations without contacts and limits agree better than before."""
        ends = [self._smooth(labs) for labs in (before, self._labs)]
        return "smooth accelerations agree" if ends[1] < _MOVED * ends[0] else ""

    def _probe_moves(
        self, probe: Callable[[Laboratory, Laboratory], list[Held]], held: Held
    ) -> Callable[[Any], str]:
        """Return what says that a probe no longer finds a difference."""
        name = held.text.partition(":")[0]

        def moves(before: Any) -> str:
            left = any(each.text.startswith(name) for each in probe(*self._labs))
            return "" if left else "its probe agrees"

        return moves

    def _smooth(self, labs: Sequence[Laboratory]) -> float:
        """Return how far smooth accelerations are apart in the episode."""
        some = range(0, len(self._moments), max(1, len(self._moments) // 50))
        found = []
        for number in some:
            moment = self._moments[number]
            torques = np.zeros(len(moment.velocities))
            first, second = (
                lab.simulation.forward_dynamics(moment.positions, moment.velocities, torques)
                for lab in labs
            )
            found.append(second - first)
        return float(norms(self._floor.masses[list(some)], np.array(found)).sum())

    # How the engines act --------------------------------------------------------------------

    def _measure(self) -> Vector:
        """Return how far the engines are apart after each step, shape (steps,), in sqrt(J)."""
        for lab in self._labs:
            if lab not in self._after:
                self._after[lab] = np.array([lab.step(each).velocities for each in self._moments])
        first, second = (self._after[lab] for lab in self._labs)
        return norms(self._floor.masses, second - first)

    def _dissect(self) -> float:
        """Look at steps one by one for what is left; return the unexplained share."""
        apart = self._apart
        parted = np.flatnonzero(apart > self._floor.bound)
        if not len(parted):
            return 0.0
        chosen = parted[np.unique(np.linspace(0, len(parted) - 1, _DISSECTED).astype(int))]
        one, other = self._labs
        moments = self._moments
        gap = gap_between(one, other, moments[:: max(1, len(moments) // 100)])
        with Anatomy(one, other, gap) as anatomy:
            found = [anatomy.shares(moments[k]) for k in chosen]
        whole = sum(sum(each.values()) for each in found) or 1.0
        scale = float(apart[parted].sum()) / self._total / whole
        if self._first is not None and chosen[0] == self._first:
            self._at_first |= {
                kind: value for kind, value in found[0].items() if kind != UNEXPLAINED
            }
        for kind, text in TEXTS.items():
            parts = [each.get(kind, 0.0) for each in found]
            moved = sum(p > _HELPS * sum(e.values()) for p, e in zip(parts, found, strict=True))
            if moved:
                confirmed = f"without it, {moved} of {len(found)} steps part less"
                told = "; ".join([text, *(self._limits if kind == LIMIT else ())])
                self._causes.append(Cause(kind, told, sum(parts) * scale, confirmed))
        if not any(cause.kind == LIMIT for cause in self._causes):
            self._unconfirmed += self._limits
        named = {cause.kind for cause in self._causes} & TEXTS.keys()
        rest = [value for each in found for kind, value in each.items() if kind not in named]
        return sum(rest) * scale


def _same(field: str) -> models.Repair:
    """Return what gives the second world a field of the first."""

    def repair(one: World, other: World) -> tuple[World, World]:
        return one, dataclasses.replace(other, **{field: getattr(one, field)})

    return repair


def _commands_apart(one: Episode, other: Episode) -> float:
    """Return how far the commands of two episodes are apart in their beginning, on average."""
    pairs = list(zip(one.moments, other.moments, strict=False))[:_BEGINNING]
    found = np.array([np.abs(first.commands - second.commands) for first, second in pairs])
    size = 1.0 + float(np.abs([first.commands for first, _ in pairs]).max(initial=0.0))
    mean = float(found.mean()) if found.size else 0.0
    return mean if mean > _EQUAL * size else 0.0


def _check_layouts(one: Laboratory, other: Laboratory) -> None:
    first, second = (lab.simulation.layout for lab in (one, other))
    if (first.joints, first.bodies) != (second.joints, second.bodies):
        raise ConfigError(
            f"The task has other joints or links on {other.engine} than on {one.engine}, so their "
            "states cannot be compared. Make it the same on all engines."
        )


def _median_and_largest(values: Vector) -> tuple[float, float]:
    return float(np.median(values)), float(np.max(values))


def _trajectories(one: Episode, other: Episode) -> tuple[float | None, float | None]:
    """Return when two episodes are apart, in s, and the rate at which they move apart, in 1/s."""
    pairs = list(zip(one.moments, other.moments, strict=False))
    distances = np.array([np.abs(a.positions - b.positions).max() for a, b in pairs])
    times = np.arange(len(pairs)) * one.world.period
    far = np.flatnonzero(distances > _AWAY)
    end = int(far[0]) if len(far) else len(pairs)
    growing = np.flatnonzero((distances > 1e-13) & (distances < 1e-2))
    away = float(times[end]) if len(far) else None
    if len(growing) < 10:
        return away, None
    rate = np.polyfit(times[growing], np.log(distances[growing]), 1)[0]
    return away, float(rate) if rate > 0 else None
