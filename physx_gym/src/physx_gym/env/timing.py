"""Timing of commands and observations within a step, in whole physics steps."""

from __future__ import annotations

import itertools
import math

from physx_core import checks
from physx_core.errors import ConfigError
from physx_sim import steps_of

Tick = tuple[bool, bool, int]
"""Whether to observe, whether to command, and how many physics steps to simulate afterwards."""


class StepTiming:
    """Periods of steps, commands and observations, and the length of an episode.

    Attributes:
        step: Physics steps of a step of the environment.
        control: Physics steps between two commands.
        observe: Physics steps between two observations.
        control_dt: Time between two commands, in s.
        observe_dt: Time between two observations, in s.
        tick: Greatest number of physics steps that divides all three.
        last: Physics steps after which an episode is truncated.
        most_steps: Steps of the environment after which an episode is truncated.
        longest: Time by which every episode is over, in s.
    """

    def __init__(
        self,
        period: float,
        step_dt: float,
        control_period: float | None,
        observe_period: float | None,
        duration: float,
    ) -> None:
        """Convert times to physics steps.

        Args:
            period: Duration of a physics step, in s.
            step_dt: Duration of a step, in s.
            control_period: Time between two commands, in s; None: one step.
            observe_period: Time between two observations, in s; None: the control period.
            duration: Time after which an episode is truncated, in s.
        """
        self.step = steps_of("step_dt", step_dt, period)
        self.control = steps_of("control_period", control_period or step_dt, period)
        self.observe = self.control
        if observe_period is not None:
            self.observe = steps_of("observe_period", observe_period, period)
        for name, steps in (("control_period", self.control), ("observe_period", self.observe)):
            if self.step % steps:
                raise ConfigError(
                    f"step_dt is {step_dt:g} s but must be a multiple of {name}, "
                    f"{steps * period:g} s."
                )
        self.control_dt, self.observe_dt = self.control * period, self.observe * period
        self.tick = math.gcd(self.step, self.control, self.observe)
        duration = checks.positive("simulation_duration_max", duration)
        self.last = math.ceil(duration / period * (1 - 1e-12))
        self.most_steps = math.ceil(self.last / self.step)
        self.longest = self.most_steps * self.step * period

    def schedule(self, is_held: bool, every_physics_step: bool) -> list[Tick]:
        """Return the ticks of a step; at its start the observation is up to date.

        Args:
            is_held: Whether one command and one observation per step are enough.
            every_physics_step: Whether every physics step is a tick.
        """
        control, observe = (self.step,) * 2 if is_held else (self.control, self.observe)
        ticks = {*range(0, self.step, control), *range(0, self.step, observe), self.step}
        times = [*range(self.step + 1)] if every_physics_step else sorted(ticks)
        return [
            (now > 0 and now % observe == 0, now % control == 0, after - now)
            for now, after in itertools.pairwise(times)
        ]
