"""A run of streams, to be killed and resumed: a generation, or a training that they ask.

Arguments: name of the session, "clients" or "local", "generation" or "training".
"""

from __future__ import annotations

import sys
from pathlib import Path

from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Training

FOLDER = Path(__file__).parent


def streams(where, **options):
    kwargs = {"parameters": True, "refuse": 5, **options.pop("env_kwargs", {})}
    options = {"num_clients": 2, "seed": 4, "record_wrong_samples": True, **options}
    return EnvironmentConfig(
        f"{FOLDER / 'stream_envs.py'}:River",
        env_kwargs=kwargs,
        as_tcp_ip_client=where == "clients",
        **options,
    )


def generation(name, environment, **options):
    options = {"batch_nb": 12, "batch_size": 7, "new_session": False, "quiet": True, **options}
    return DataGeneration(
        environment, DatasetConfig(max_file_size=1e-4), session_name=name, **options
    )


def training(name, environment, *, cls=Training, **options):
    network = NetworkConfig(
        "toy/linear",
        optimization=f"{FOLDER / 'online_run.py'}:Descending",
        network_kwargs={"net_fields": "x", "opt_fields": "y"},
    )
    counts = {"epoch_nb": 2, "batch_nb": 12, "batch_size": 7, "checkpoint_every": 3}
    options = {**counts, "seed": 3, "new_session": False, "quiet": True, **options}
    data = DatasetConfig(normalize=True, max_file_size=1e-4)
    return cls(network, data, environment, session_name=name, **options)


if __name__ == "__main__":
    name, where, what = sys.argv[1:]
    kwargs = {"delay": 0.004, "asks": what == "training"}
    environment = streams(where, state_every=5, env_kwargs=kwargs)
    run = generation if what == "generation" else training
    run(name, environment, resume=Path("sessions", name).exists()).execute()
