"""Gradient descent for the linear model, which tells how many batches it was really given."""

import os
import signal
import sys
import time

import numpy as np

from physx_core import Optimization
from physx_core.errors import ConfigError


class Descent(Optimization):
    """Follows the gradient of the mean square; each batch appends a byte to a file."""

    def __init__(self, pause=0.0):
        self.pause = pause

    def set_optimizer(self, optimizer, network, **kwargs):
        self.network, self.rate = network, kwargs.pop("lr", 0.1)
        if self.rate == 0.123:
            raise ConfigError("This rate is of no use: give another lr.")

    def compute_loss(self, batch):
        name = self.network.opt_fields[0]
        self.rows = self.network.rows(batch.data)
        self.error = batch.prediction[name] - batch.targets[name]
        return float(np.mean(self.error**2))

    def optimize(self, loss):
        time.sleep(self.pause)
        self.network.weights = self.network.weights - self.rate * self.rows.T @ self.error / len(
            self.rows
        )
        if (
            "PHYSX_TEST_BATCHES" in os.environ
        ):  # beside the trial's folder, as a trial may start over
            place = f"{sys.argv[1]}.batches"
            descriptor = os.open(place, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            os.write(descriptor, b".")
            os.close(descriptor)


class Doomed(Descent):
    """Kills its process, as a system does that has no memory left."""

    def optimize(self, loss):
        os.kill(os.getpid(), signal.SIGKILL)
