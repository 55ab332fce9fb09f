"""A training whose sampler learns from its losses, to be killed and resumed.

Arguments: name of the session, whether clients generate, the buffer. It resumes the session if
there is one.
"""

from __future__ import annotations

import sys
from pathlib import Path

from physx_core import EnvironmentConfig, NetworkConfig, Training

HARD = f"{Path(__file__).parent / 'parameter_envs.py'}:Hard"
BUFFERS = {
    "stream": {},
    "reservoir": {
        "online": "physx/reservoir",
        "online_kwargs": {"capacity": 40, "watermark": 20, "views": 2},
    },
}


def training(name, over_tcp, buffer):
    environment = EnvironmentConfig(
        HARD,
        env_kwargs={"pause": 0.004},
        as_tcp_ip_client=over_tcp,
        num_clients=2,
        seed=4,
        sampler="physx/active",
        sampler_kwargs={"delay": 1, "memory": 30},
    )
    options = {"net_fields": "x", "opt_fields": "y"}
    return Training(
        NetworkConfig(
            f"{Path(__file__).parent / 'online_run.py'}:Linear",
            optimization=f"{Path(__file__).parent / 'online_run.py'}:Descending",
            network_kwargs=options,
        ),
        None,
        environment,
        session_name=name,
        new_session=False,
        epoch_nb=2,
        batch_nb=30,
        batch_size=7,
        seed=3,
        quiet=True,
        checkpoint_every=7,
        resume=Path("sessions", name).exists(),
        **BUFFERS[buffer],
    )


if __name__ == "__main__":
    training(sys.argv[1], sys.argv[2] == "clients", sys.argv[3]).execute()
