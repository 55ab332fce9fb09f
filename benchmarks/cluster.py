"""Clients on two nodes of Ray against clients on this machine: the overhead of the launcher.

    python benchmarks/cluster.py --check

Ray is started here with two nodes of one processor each, and this process connects to it before
anything is timed. The last claim, about sweeps that are killed, is that of cluster_sweep.py.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from cluster_sweep import survives_kills
from measure import claim, finish, rates, report
from ray.cluster_utils import Cluster
from transport import times_as_long
from transport_environments import Sleeping, Working, compute

from physx_core import DataGeneration, EnvironmentConfig
from physx_core.observers import Observers
from physx_core.pipelines.services import RunServices
from physx_core.sources import ClientSource

ROUNDS = 5
SEED = [0, 0, 0]
CLIENTS = 8
MANY = 64

_NAMES = itertools.count()


@contextlib.contextmanager
def two_nodes() -> Iterator[None]:
    """Run Ray with two nodes, and connect this process to them."""
    folder = os.environ["RAY_TMPDIR"] = tempfile.mkdtemp(prefix="ray", dir="/tmp")
    options: dict[str, Any] = {"num_cpus": 1, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=options)
    try:
        cluster.add_node(num_cpus=1)
        ray.init(cluster.address, log_to_driver=False, logging_level=logging.ERROR)
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def on_ray(clients: int) -> dict[str, Any]:
    """Return the options for clients that share two processors."""
    share = min(1.0, 2 / clients)
    return {"launcher": "cluster/ray", "launcher_kwargs": {"num_cpus": share}}


def generation(
    root: Path, environment: type[Any], arguments: dict[str, Any], rows: int, **options: Any
) -> Iterator[int]:
    """Generate and store rows with clients that are started before the timing begins."""
    clients = options["num_clients"]
    pipeline = DataGeneration(
        EnvironmentConfig(environment, env_kwargs=arguments, seed=0, **options),
        session_dir=str(root),
        session_name=f"generation_{next(_NAMES)}",
        batch_nb=rows // clients,
        batch_size=clients,
        quiet=True,
    )
    with pipeline:
        yield 0
        for _ in range(pipeline.batch_nb):
            pipeline.batch_begin()
            pipeline.batch_produce()
            pipeline.batch_count()
            pipeline.batch_end()
        yield rows
    shutil.rmtree(pipeline.session.path)


def working(root: Path) -> bool:
    """Compare two clients on two nodes with two on this machine; each step computes for 20 ms."""
    units = 20_000
    begin = time.perf_counter()
    compute(units)
    work = round(units * 20e-3 / (time.perf_counter() - begin))
    arguments = {"work": work, "block": 1}

    def run(**options: Any) -> Iterator[int]:
        return generation(root, Working, arguments, 200, num_clients=2, **options)

    candidates = {"this machine": run, "two nodes of Ray": lambda: run(**on_ray(2))}
    measured = rates(candidates, ROUNDS)
    heading = "Simulations of 20 ms, 2 clients"
    return report(heading, "samples", measured, "this machine", 0.95, "two nodes of Ray")


def starting(root: Path, environment: str, target: float | None) -> bool:
    """Compare the start of 8 clients on two nodes with that on this machine.

    Args:
        root: Folder for output.
        environment: The environment of the clients.
        target: How many times as long it may take; None: it is only printed.
    """

    def run(**options: Any) -> Iterator[int]:
        config = EnvironmentConfig(environment, num_clients=CLIENTS, seed=0, **options)
        yield 0
        with ClientSource(config, RunServices(root, Observers([]), None), SEED):
            yield 1

    def bare() -> Iterator[int]:
        yield 0
        actors = [Nothing.options(scheduling_strategy="SPREAD").remote() for _ in range(CLIENTS)]
        ray.get([actor.answer.remote() for actor in actors])
        yield 1
        for actor in actors:
            ray.kill(actor)

    candidates = {
        "this machine": run,
        "two nodes of Ray": lambda: run(**on_ray(CLIENTS)),
        "bare Ray: 8 empty actors": bare,
    }
    print(f"Start of {CLIENTS} clients of {environment}, until all are ready")
    ratio = times_as_long(rates(candidates, ROUNDS), "two nodes of Ray", "this machine")
    if target is None:
        print(f"  it takes {ratio:.2f} times as long, without a target\n")
        return True
    return claim("the start takes as many times as long", ratio, at_most=target)


@ray.remote(num_cpus=0)
class Nothing:
    """An empty actor."""

    def answer(self) -> None:
        """Do nothing."""


def sleeping(root: Path) -> bool:
    """Compare 64 clients through the launcher with one, whose steps sleep for 50 ms."""
    rows = 40

    def clients(number: int) -> Iterator[int]:
        options = {"num_clients": number, "timeout": 300.0, **on_ray(number)}
        return generation(root, Sleeping, {"seconds": 0.05}, number * rows, **options)

    candidates = {"1 client": lambda: clients(1), f"{MANY} clients": lambda: clients(MANY)}
    measured = rates(candidates, 3)
    heading = "50 ms of sleep per sample, on two nodes of Ray"
    return report(heading, "samples", measured, "1 client", 0.9 * MANY, f"{MANY} clients")


def main() -> None:
    """Print all figures; with --check, end with status 1 if a target is missed."""
    met = []
    with tempfile.TemporaryDirectory(prefix="physx-cluster-") as name, two_nodes():
        root = Path(name)
        met.append(working(root))
        met.append(starting(root, "toy/spring", None))
        met.append(starting(root, "dart/arm", 1.5))
        met.append(sleeping(root))
    met += survives_kills()
    finish(met)


if __name__ == "__main__":
    main()
