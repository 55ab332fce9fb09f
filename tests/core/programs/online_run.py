"""A training whose environments generate while it learns, to be killed and resumed.

Arguments: name of the session, "clients" or "local", whether environments generate in every epoch
("always") or "once", the buffer, and the sampler. It resumes the session if there is one.
"""

from __future__ import annotations

import sys
from pathlib import Path

from physx_core import DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.toy import LeastSquares, Linear

APPRENTICE = f"{Path(__file__).parent / 'online_envs.py'}:Apprentice"


class Descending(LeastSquares):
    """Has no state but the weights; learns normalized values."""

    def optimize(self, loss):
        error = self._rows @ self._network.weights - self._targets
        self._network.weights = self._network.weights - 0.02 * self._rows.T @ error


SAMPLERS = {"sobol": {}, "active": {"memory": 30}}


def training(name, over_tcp, always, online, sampler):
    is_stream = sampler == "sobol"
    environment = EnvironmentConfig(
        APPRENTICE,
        episode_steps=None if is_stream else 3,
        sampler=f"physx/{sampler}",
        sampler_kwargs=SAMPLERS[sampler],
        env_kwargs={"delay": 0.004, "refuse": 5 if is_stream else 0},
        as_tcp_ip_client=over_tcp,
        always_produce=always,
        record_wrong_samples=is_stream,
        num_clients=2,
        seed=4,
    )
    options = {"net_fields": "x", "opt_fields": "y"}
    return Training(
        NetworkConfig(Linear, optimization=Descending, network_kwargs=options),
        DatasetConfig(normalize=True, max_file_size=1e-4),
        environment,
        session_name=name,
        new_session=False,
        epoch_nb=3,
        batch_nb=30,
        batch_size=7,
        seed=3,
        run_ahead=6,
        quiet=True,
        checkpoint_every=7,
        online=f"physx/{online}",
        online_kwargs={} if online == "stream" else {"capacity": 80, "watermark": 40, "views": 2},
        resume=Path("sessions", name).exists(),
    )


if __name__ == "__main__":
    name, where, how_often, buffer, sampler = sys.argv[1:]
    training(name, where == "clients", how_often == "always", buffer, sampler).execute()
