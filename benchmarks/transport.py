"""Clients over TCP against raw sockets, bare loops and interpreters: all claims about their speed.

Samples of 48 B hold 6 numbers, samples of 48 kB hold 6000, as float64 in two fields. Candidates run
alternately with their baseline and do the same amount of work in each round; clients that run ahead
are restarted for each round, so none of their work is done in another candidate's time. Starting
them is timed only in the line about it.

``--costs [PAGE]`` prints only what clients and rows cost: the table in docs/scale.md.
"""

from __future__ import annotations

import itertools
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cores import on_core, two_cores
from measure import claim, finish, rates, report
from raw_tcp import raw_answers, raw_blocks, raw_client, raw_stream
from transport_costs import print_costs
from transport_environments import Asking, Episodes, Rows, Sleeping, Working, compute

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    Field,
    NetworkConfig,
)
from physx_core.observers import Observers
from physx_core.pipelines import Learner
from physx_core.pipelines.services import RunServices
from physx_core.sources import ClientSource, LocalSource
from physx_core.typing import Batch

ROUNDS = 7
FEWER = 5  # where many processes are started in each round
SEED = [0, 0, 0]
SIZES = {"48 B": 6, "48 kB": 6000}

Work = Callable[[], int | Iterator[int]]


def times_as_long(measured: dict[str, list[float]], name: str, baseline: str) -> float:
    """Print each candidate's time; return how many times as long `name` takes as `baseline`."""
    for candidate, each in measured.items():
        print(f"  {candidate:28} {1e6 / statistics.median(each):12,.1f} µs")
    pairs = zip(measured[name], measured[baseline], strict=True)
    return statistics.median(base / mine for mine, base in pairs)


# Predictions ------------------------------------------------------------------------------------


def unchanged(batch: Batch) -> Batch:
    """Return the prediction of a network that does nothing."""
    return batch


def predictions_over_tcp(root: Path, title: str, cores: list[int]) -> float:
    """Compare `get_prediction` of a client with a raw ping-pong of the same bytes.

    Args:
        root: Folder for output.
        title: Size of a sample.
        cores: Processor cores of this process and of the clients, one each; empty: any.

    Returns:
        How many times as long `get_prediction` takes.
    """
    values, count = SIZES[title], 2000 if cores else 4000
    core = cores[1] if cores else None
    services = RunServices(root, Observers([]), unchanged)
    arguments = {"values": values, "asks": count, "core": core}
    config = EnvironmentConfig(Asking, env_kwargs=arguments, seed=0)
    with (
        on_core(cores[0] if cores else None),
        raw_client(8 * values, "ask", core) as connection,
        ClientSource(config, services, SEED, run_ahead=0) as source,
    ):

        def get_prediction() -> int:
            source.batch(1)
            return count

        candidates: dict[str, Work] = {
            "raw TCP ping-pong": lambda: raw_answers(connection, 8 * values, 2 * count),
            "get_prediction": get_prediction,
        }
        measured = rates(candidates, ROUNDS)
    where = "each process on a core of its own" if cores else "on cores of the kernel's choice"
    print(f"get_prediction over TCP with a network that does nothing, {title}, {where}")
    return times_as_long(measured, "get_prediction", "raw TCP ping-pong")


def all_predictions_over_tcp(root: Path) -> list[bool]:
    """Compare both sizes of samples; the claim is about processes on separate cores.

    In a run, server and clients work at the same time, and so on different cores. If nothing else
    runs, the kernel instead puts both ends of a ping-pong on one core: there, a message takes only
    8 µs, about as long as Python takes to call its functions a hundred times.
    """
    met = []
    cores = two_cores()
    for title in SIZES:
        if cores:
            ratio = predictions_over_tcp(root, title, [])
            print(f"  get_prediction takes {ratio:.2f} times as long there, without a target\n")
        ratio = predictions_over_tcp(root, title, cores)
        met.append(claim("get_prediction takes as many times as long", ratio, at_most=1.9))
    return met


def predictions_in_process(root: Path) -> bool:
    """Compare `get_prediction` in one process with a bare forward call and its conversions."""
    count = 6000
    network = {"layers": [5, 5, 5, 1], "net_fields": "x", "opt_fields": "y"}
    config = NetworkConfig("torch/fc", network, loss="MSELoss", optimizer="Adam", lr=1e-3)
    learner = Learner(config, trains=True)
    learner.bind({"x": Field("x", (5,)), "y": Field("y", (1,))}, {})
    learner.network.set_train()
    services = RunServices(root, Observers([]), learner.predict_in_training)
    layers: torch.nn.Sequential = learner.network.layers  # type: ignore[attr-defined]
    sample = np.zeros(5)

    def forward() -> int:
        for _ in range(count):
            with torch.no_grad():
                inputs = torch.from_numpy(sample[np.newaxis]).to(torch.float32)
                layers(inputs).numpy()[0]
        return count

    environment = EnvironmentConfig(Asking, env_kwargs={"values": 6, "asks": count}, seed=0)
    with LocalSource(environment, services, SEED) as source:

        def get_prediction() -> int:
            source.batch(1)
            return count

        measured = rates({"forward": forward, "get_prediction": get_prediction}, ROUNDS)
    print("get_prediction in one process, torch/fc [5, 5, 5, 1]; the forward call with conversions")
    ratio = times_as_long(measured, "get_prediction", "forward")
    return claim("get_prediction takes as many times as long", ratio, at_most=2)


# Generation -------------------------------------------------------------------------------------

_NAMES = itertools.count()


def generation(
    root: Path,
    environment: type[Any],
    arguments: dict[str, Any],
    rows: int,
    batch: int,
    clients: int,
    dataset: DatasetConfig | None = None,
) -> Iterator[int]:
    """Generate and store rows with clients that are started before the timing begins."""
    pipeline = DataGeneration(
        EnvironmentConfig(environment, env_kwargs=arguments, num_clients=clients, seed=0),
        dataset,
        session_dir=str(root),
        session_name=f"generation_{next(_NAMES)}",
        batch_nb=rows // batch,
        batch_size=batch,
    )
    with pipeline:
        yield 0
        for _ in range(rows // batch):
            pipeline.batch_begin()
            pipeline.batch_produce()
            pipeline.batch_count()
            pipeline.batch_end()
        yield rows
    shutil.rmtree(pipeline.session.path)


def generation_small(root: Path) -> bool:
    """Compare streaming to disk with asking for each sample and waiting for it."""
    rows, few = 200_000, 5000
    arguments = {"values": SIZES["48 B"]}
    config = EnvironmentConfig(Rows, env_kwargs=arguments, seed=0)

    def one_by_one() -> Iterator[int]:
        services = RunServices(root, Observers([]), None)
        folder = root / f"synchronous_{next(_NAMES)}"
        with (
            Dataset.create(folder) as dataset,
            ClientSource(config, services, SEED, run_ahead=0) as source,
        ):
            source.batch(1)
            yield 0
            for _ in range(few):
                row = source.batch(1)
                dataset.append_sample("training", {name: values[0] for name, values in row.items()})
            dataset.flush()
            yield few
        shutil.rmtree(folder)

    def streamed() -> Iterator[int]:
        return generation(root, Rows, arguments, rows, 1000, 1)

    candidates: dict[str, Work] = {"each asked for": one_by_one, "streamed": streamed}
    measured = rates(candidates, ROUNDS)
    heading = "Generation of 48 B samples with 1 client, to disk"
    return report(heading, "samples", measured, "each asked for", 10, "streamed")


def generation_large(root: Path) -> bool:
    """Compare streaming large samples to disk with a raw stream that is discarded.

    The rate of the raw stream when it is written to a plain file as it arrives is printed with the
    claim. It depends on where the memory of the system's cache comes from: writing to memory that
    was in use a moment ago is twice as fast as the raw stream, but a virtual machine may have to
    ask its host for each page, and then it is ten times as slow.
    """
    values, rows = SIZES["48 kB"], 2000
    small = DatasetConfig(max_file_size=0.05)

    def streamed(dataset: DatasetConfig | None = None) -> Iterator[int]:
        return generation(root, Rows, {"values": values}, rows, 100, 1, dataset)

    with raw_client(8 * values, "stream") as connection:
        candidates: dict[str, Work] = {
            "raw TCP stream": lambda: raw_stream(connection, 8 * values, 2 * rows),
            "the same into a file": lambda: stream_to_file(
                connection, root / "stream", 8 * values, rows
            ),
            "streamed to disk": streamed,
            "in partitions of 50 MB": lambda: streamed(small),
        }
        measured = rates(candidates, 3 * ROUNDS)
    in_mb = {name: [rate * 8e-6 * values for rate in each] for name, each in measured.items()}
    heading = (
        "Generation of 48 kB samples with 1 client, to disk; sealed meanwhile: small partitions"
    )
    print(heading)
    for name, each in in_mb.items():
        spread = f"[{min(each):,.0f} .. {max(each):,.0f}]"
        print(f"  {name:28} {statistics.median(each):12,.0f} MB/s  {spread}")

    def share(name: str, of: str) -> float:
        pairs = zip(in_mb[name], in_mb[of], strict=True)
        return statistics.median(mine / other for mine, other in pairs)

    into_file, raw = "the same into a file", "raw TCP stream"
    print(f"  {into_file}: {share(into_file, raw):.2f} of the stream that nobody keeps", end="; ")
    print(f"streamed to disk: {share('streamed to disk', into_file):.2f} of that")
    return claim("streamed to disk", share("streamed to disk", raw), at_least=0.45)


def stream_to_file(connection: socket.socket, path: Path, size: int, count: int) -> Iterator[int]:
    """Write `count` messages to a file as they arrive, into preallocated space."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    yield 0
    os.posix_fallocate(descriptor, 0, size * count)
    place = 0
    for block in raw_blocks(connection, size, count):
        place += os.pwrite(descriptor, block, place)
    yield count
    os.close(descriptor)
    path.unlink()


def generation_working(root: Path, milliseconds: float, target: float) -> bool:
    """Compare a client whose steps compute for a while with the computation alone.

    Both alternate in the client, every 20 ms: other load on the machine changes its speed by more
    than what is measured here, so they must be close in time.
    """
    units, seconds = 20_000, []
    for _ in range(9):
        begin = time.perf_counter()
        compute(units)
        seconds.append(time.perf_counter() - begin)
    work = round(units * 1e-3 * milliseconds / min(seconds))
    block, blocks, batches = round(20 / milliseconds), 400, 10
    rows = blocks * (block + 1)
    arguments = {"work": work, "block": block}
    with DataGeneration(
        EnvironmentConfig(Working, env_kwargs=arguments, num_clients=1, seed=0),
        session_dir=str(root),
        session_name=f"working_{milliseconds:g}",
        batch_nb=batches,
        batch_size=rows // batches,
    ) as pipeline:
        pipeline.execute()
    with Dataset.open(pipeline.session.path / "dataset") as dataset:
        stored = dataset["training"]
        begins, ends = (stored[name][:][:, 0].reshape(blocks, block + 1) for name in ("x", "y"))
    alone = (ends - begins)[:-1, 0]
    with_samples = begins[1:, 0] - begins[:-1, 1]
    print(f"{milliseconds:g} ms of simulation per sample, 1 client")
    for name, spent in (("simulation alone", alone), ("with samples", with_samples)):
        print(f"  {name:28} {block / np.median(spent):12,.1f} steps/s")
    print(f"  ratio of all their times: {alone.sum() / with_samples.sum():.3f}")
    return claim("ratio", float(np.median(alone / with_samples)), at_least=target)


def generation_by_clients(root: Path) -> bool:
    """Compare large samples that pass through the server with those that clients write themselves.

    They are of independent episodes with a parameter. On one machine, both end up on the same disk;
    the server's time per sample limits how many clients it can have.
    """
    values, rows = 60_000, 480

    def of(writers: str) -> Work:
        dataset = DatasetConfig(writers=writers, max_file_size=0.05)
        return lambda: generation(root, Episodes, {"values": values}, rows, 48, 2, dataset)

    candidates = {"through the server": of("server"), "written by clients": of("clients")}
    print("Generation of 480 kB samples with 2 clients, to one disk")
    found = rates(candidates, FEWER)
    for name, each in found.items():
        median = statistics.median(each)
        print(f"  {name:28} {median:12,.0f} samples/s {8e-6 * values * median:10,.0f} MB/s")
    pairs = zip(found["written by clients"], found["through the server"], strict=True)
    times = statistics.median(mine / base for mine, base in pairs)
    met = claim("as many samples/s, written by clients", times, at_least=3)
    print("Processor time of the server for each of them")
    measured = rates(candidates, FEWER, time.process_time)
    ratio = times_as_long(measured, "written by clients", "through the server")
    return claim("the server's time for a sample, written by clients", ratio, at_most=0.5) and met


def generation_sleeping(root: Path) -> bool:
    """Compare 8 clients whose steps sleep with one."""
    rows = 80

    def clients(number: int) -> Work:
        return lambda: generation(
            root, Sleeping, {"seconds": 5e-3}, number * rows, number * rows // 8, number
        )

    measured = rates({"1 client": clients(1), "8 clients": clients(8)}, FEWER)
    heading = "5 ms of sleep per sample"
    return report(heading, "samples", measured, "1 client", 7.5, "8 clients")


# Set-up and the server's own time ---------------------------------------------------------------


def setting_up(root: Path) -> bool:
    """Compare 8 clients, up to their first samples, with 8 interpreters that import NumPy."""

    def interpreters() -> int:
        # In separate sessions, like clients: the kernel shares processors among sessions.
        command = [sys.executable, "-c", "import numpy"]
        started = [subprocess.Popen(command, start_new_session=True) for _ in range(8)]
        for process in started:
            process.wait()
        return 1

    def clients() -> Iterator[int]:
        services = RunServices(root, Observers([]), None)
        config = EnvironmentConfig("toy/spring", num_clients=8, seed=0)
        yield 0
        with ClientSource(config, services, SEED) as source:
            source.batch(8)
            yield 1

    measured = rates({"8 interpreters": interpreters, "8 clients": clients}, FEWER)
    print("Set-up: 8 clients of toy/spring, from start to the first sample of each")
    ratio = times_as_long(measured, "8 clients", "8 interpreters")
    return claim("setting up takes as many times as long", ratio, at_most=2)


def server_time(root: Path) -> None:
    """Print the processor time of the server per sample."""
    rows = 200_000

    def of(clients: int) -> Work:
        return lambda: generation(root, Rows, {"values": SIZES["48 B"]}, rows, 1000, clients)

    candidates = {f"{clients:2} clients": of(clients) for clients in (1, 8, 32)}
    print("Processor time of the server for each sample of 48 B, stored in blocks of 1000")
    measured = rates(candidates, 2, time.process_time)
    growth = times_as_long(measured, "32 clients", " 1 clients")
    print(f"  growth from 1 to 32 clients: {growth:.2f} times\n")


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        if "--costs" in sys.argv:
            pages = sys.argv[sys.argv.index("--costs") + 1 :]
            print_costs(root, Path(pages[0]) if pages else None)
            return
        met = all_predictions_over_tcp(root)
        met.append(predictions_in_process(root))
        met.append(generation_small(root))
        met.append(generation_large(root))
        met.append(generation_by_clients(root))
        met.append(generation_working(root, 0.5, 0.9))
        met.append(generation_working(root, 5, 0.98))
        met.append(generation_sleeping(root))
        met.append(setting_up(root))
        server_time(root)
    finish(met)


if __name__ == "__main__":
    main()
