"""A training on independent episodes, to be killed and resumed.

Arguments: the buffer, and the number of clients.
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
RESERVOIR = {
    "online": "physx/reservoir",
    "online_kwargs": {"capacity": 30, "watermark": 12, "views": 2},
}


def train(name, clients=0, *, cls=Training, training=None, **options):
    config = EnvironmentConfig(
        LESSON,
        env_kwargs={key: options.pop(key) for key in LESSON_OPTIONS if key in options},
        as_tcp_ip_client=clients > 0,
        num_clients=max(clients, 1),
        seed=4,
        **options,
    )
    network = NetworkConfig(
        Linear,
        optimization=f"{PROGRAMS / 'online_run.py'}:Descending",
        network_kwargs={"net_fields": "x", "opt_fields": "y"},
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
        numbers = dataset.episode_values("training", "number", slice(None))
        assert numbers.tolist() == data["episode"][:].tolist()
    if run.online != "physx/stream":
        found["drawn"] = read_drawn_rows(run.session.path).tobytes()
    return found | {"weights": run.learner.network.weights.tobytes()}


if __name__ == "__main__":
    buffer, clients = sys.argv[1:]
    options = {"batch_nb": 30, "checkpoint_every": 7, "new_session": False}
    options |= {"resume": Path("sessions/run").exists()}
    options |= RESERVOIR if buffer == "reservoir" else {}
    run = train("run", int(clients), delay=0.005, training=options)
    found = {name: blake2b(content).hexdigest() for name, content in result(run).items()}
    Path("result.txt").write_text(repr(found))
