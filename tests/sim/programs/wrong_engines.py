"""Engines with mistakes: Pinocchio, and what is done to it."""

import os
import signal
from dataclasses import replace

import numpy as np

from physx_dart.pinocchio.simulation import PinocchioSimulation
from physx_sim import Backend


class Wrong(Backend):
    """Builds the class `made`, of a changed world."""

    made = PinocchioSimulation

    def build(self, world, seed=None):
        return self.made(self.changed(world))

    def changed(self, world):
        return world


class InAnotherWorld(Wrong):
    """Everything is heavier, smoother, and bounces less."""

    def changed(self, world):
        things = [
            replace(one, friction=0.3, restitution=0.9 * one.restitution) for one in world.objects
        ]
        gravity = tuple(1.001 * part for part in world.gravity)
        return replace(world, gravity=gravity, objects=things)


class KeepsImpulses(Wrong):
    class made(PinocchioSimulation):
        def clear_warm_start(self):
            pass


class Careless(Wrong):
    """Forgets commands, claims rays, takes any torques, and is imprecise."""

    class made(PinocchioSimulation):
        def __init__(self, world):
            super().__init__(world)
            self.features = self.features | {"raycast"}

        def restore(self, state):
            super().restore(replace(state, commands=0 * state.commands))

        def set_torques(self, torques):
            super().set_torques(np.nan_to_num(torques))

        def inverse_dynamics(self, positions, velocities, accelerations):
            return 1.0001 * super().inverse_dynamics(positions, velocities, accelerations)


class Invents(Wrong):
    class made(PinocchioSimulation):
        def __init__(self, world):
            super().__init__(world)
            self.features = self.features | {"antigravity"}


class LivesOn(Wrong):
    class made(PinocchioSimulation):
        def close(self):
            pass


class Aliases(Wrong):
    class made(PinocchioSimulation):
        def positions(self, out=None):
            found = super().positions()
            if not hasattr(self, "own") or self.frame != self.read:
                self.own, self.read = found, self.frame
            if out is not None:
                out[:] = self.own
                return out
            return self.own


class Crowded(Wrong):
    class made(PinocchioSimulation):
        open = 0

        def __init__(self, world):
            super().__init__(world)
            Crowded.made.open += 1

        def close(self):
            Crowded.made.open -= 1
            super().close()

        def step(self, n=1):
            velocities = self.velocities()
            self.set_state(self.positions(), velocities * (1 + 1e-9 * Crowded.made.open))
            super().step(n)


class Crashes(Wrong):
    class made(PinocchioSimulation):
        def mass_matrix(self, positions):
            os.kill(os.getpid(), signal.SIGSEGV)
