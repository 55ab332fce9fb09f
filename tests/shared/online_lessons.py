"""A training on independent episodes, to be killed and resumed.

Arguments: the environment, the buffer, and the number of clients.
"""

from __future__ import annotations

import sys
from hashlib import blake2b
from pathlib import Path

from physx_core import Dataset, DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.pipelines import read_drawn_rows
from physx_core.toy import Linear

PROGRAMS = Path(__file__).parents[1] / "core" / "programs"
LESSON = f"{PROGRAMS / 'online_envs.py'}:Lesson"
HEAT = f"{Path(__file__).parents[2] / 'examples/environments/heat.py'}:Heat"
RESERVOIR = {
    "online": "physx/reservoir",
    "online_kwargs": {"capacity": 30, "watermark": 12, "views": 2},
}


def train(
    name,
    clients=0,
    *,
    environment=LESSON,
    fields=("x", "y"),
    cls=Training,
    training=None,
    **options,
):
    config = EnvironmentConfig(
        environment,
        env_kwargs={key: options.pop(key) for key in LESSON_OPTIONS if key in options},
        as_tcp_ip_client=clients > 0,
        num_clients=max(clients, 1),
        seed=4,
        **options,
    )
    network = NetworkConfig(
        Linear,
        optimization=f"{PROGRAMS / 'online_run.py'}:Descending",
        network_kwargs=dict(zip(("net_fields", "opt_fields"), fields, strict=True)),
    )
    chosen = {"epoch_nb": 1, "batch_nb": 8, "batch_size": 7, "seed": 3, **(training or {})}
    run = cls(network, DatasetConfig(normalize=True), config, session_name=name, quiet=True,
              **chosen)  # fmt: skip
    run.execute()
    return run


LESSON_OPTIONS = ("delay", "fails", "dies", "asks", "rejects")


def result(run):
    """Return the rows, which of them each batch held, and the network, as bytes."""
    with Dataset.open(run.session.dataset_dir) as dataset:
        assert dataset.verify() == []
        data = dataset["training"]
        found = {name: data[name][:].tobytes() for name in data}
        if "number" in dataset.episode_fields:
            numbers = dataset.episode_values("training", "number", slice(None))
            assert numbers.tolist() == data["episode"][:].tolist()
    if run.online != "physx/stream":
        found["drawn"] = read_drawn_rows(run.session.path).tobytes()
    return found | {"weights": run.learner.network.weights.tobytes()}


if __name__ == "__main__":
    environment, buffer, clients = sys.argv[1:]
    training = {"batch_nb": 30, "checkpoint_every": 7, "new_session": False}
    training |= {"resume": Path("sessions/run").exists()}
    training |= RESERVOIR if buffer == "reservoir" else {}
    options = {"delay": 0.005}
    if environment == "heat":
        options = {"environment": HEAT, "fields": ("input", "temperature")}
        options |= {"sampler": "physx/active", "state_every": 4}
        training |= {"batch_nb": 90, "run_ahead": 8}
    run = train("run", int(clients), training=training, **options)
    found = {name: blake2b(content).hexdigest() for name, content in result(run).items()}
    Path("result.txt").write_text(repr(found))
