"""What is due when in a step of an environment, in whole physics steps."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

from physx_core import checks
from physx_core.errors import ConfigError
from physx_core.simulation import steps_of

if TYPE_CHECKING:
    from physx_gym.simulator.simulator import Simulator

Moment = tuple[bool, bool, int]
"""Whether to observe, whether to command, and how many physics steps to simulate then."""


class Periods:
    """Periods of a step, of commands and of observations.

    Attributes:
        whole: Physics steps of a step of the environment.
        control: Of the time between two commands.
        observe: Of the time between two observations.
        moment: All of these are multiples of so many.
        last: Physics steps after which an episode is truncated.
        longest: Time at which every episode is over, in s.
    """

    def __init__(self, step_dt: float, duration: float, simulator: Simulator) -> None:
        """Check that all fits together.

        Args:
            step_dt: Time of a step, in s.
            duration: Time after which an episode is truncated, in s.
            simulator: With the other periods.

        Raises:
            ConfigError: A step is no multiple of the other periods, or these of the physics'.
        """
        period, given = simulator.period, simulator.observe_period
        self.whole = steps_of("step_dt", step_dt, period)
        self.control = steps_of("control_period", simulator.control_period or step_dt, period)
        self.observe = self.control
        if given is not None:
            self.observe = steps_of("observe_period", given, period)
        for name, steps in (("control_period", self.control), ("observe_period", self.observe)):
            if self.whole % steps:
                raise ConfigError(
                    f"step_dt is {step_dt:g} s but must be a multiple of {name}, "
                    f"{steps * period:g} s."
                )
        self.control_dt, self.observe_dt = self.control * period, self.observe * period
        self.moment = math.gcd(self.whole, self.control, self.observe)
        duration = checks.positive("simulation_duration_max", duration)
        self.last = math.ceil(duration / period * (1 - 1e-12))
        self.longest = math.ceil(self.last / self.whole) * self.whole * period

    def schedule(self, held: bool, every: bool) -> list[Moment]:
        """Return the moments of a step; at its begin the observation is fresh.

        Args:
            held: Whether commands and observations within a step change nothing, so that they are
                left out.
            every: Whether every physics step is a moment.
        """
        control, observe = (self.whole,) * 2 if held else (self.control, self.observe)
        moments = {*range(0, self.whole, control), *range(0, self.whole, observe), self.whole}
        times = [*range(self.whole + 1)] if every else sorted(moments)
        return [
            (now > 0 and now % observe == 0, now % control == 0, after - now)
            for now, after in itertools.pairwise(times)
        ]
