"""The cost of clients and rows for a run: the table in docs/scale.md, by `transport.py --costs`.

A server is measured with clients that simulate nothing, all in one other process
(`many_clients.py`). The measure is the processor time of the server's process; costs per client and
per frame are differences between two runs, so one-time costs cancel. Encrypted connections use an
address of this machine that is not a loopback one.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import resource
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from transport_environments import Asking

from physx_core import Dataset, EnvironmentConfig
from physx_core.observers import Observers
from physx_core.pipelines.services import RunServices
from physx_core.sources import ClientSource

SEED = [0, 0, 0]
FEW, MANY = 20, 120
PARTITIONS = 1000
SMALL, LARGE = 6, 6000  # values of float64
MARKS = ("<!-- costs: written by benchmarks/transport.py --costs -->", "<!-- end of costs -->")

Row = tuple[str, str, str]


def outside_address() -> str | None:
    """Return an address of this machine that is not a loopback one, if there is one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.200", 9))  # sends nothing
        except OSError:
            return None
        found: str = probe.getsockname()[0]
        return None if found.startswith("127.") else found


def memory() -> float:
    """Return the memory of this process in kB."""
    return _kilobytes(os.getpid())


def _kilobytes(process: int | str) -> float:
    """Return the memory of a process in kB, with its part of shared memory."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii")
    return float(text.partition("\nPss:")[2].split()[0])


@contextlib.contextmanager
def served(
    root: Path, address: str, clients: int, values: int, rows: int, total: int | None = None
) -> Iterator[ClientSource]:
    """Yield the source of some clients, not open yet, which send `total` rows in all."""
    with socket.create_server((address, 0)) as free:
        port = free.getsockname()[1]
    config = EnvironmentConfig(
        "toy/spring", launcher="physx/manual", num_clients=clients, ip_address=address, port=port
    )
    services = RunServices(root, Observers([]), None)
    program = Path(__file__).with_name("many_clients.py")
    words = [f"{address}:{port}", clients, values, rows]
    process = subprocess.Popen([sys.executable, str(program), *map(str, words)])
    source = ClientSource(config, services, SEED, total=total)
    try:
        yield source
    finally:
        process.kill()
        process.wait()
        with contextlib.suppress(Exception):  # its clients do not sign off
            source.close()


def joining(root: Path, address: str, clients: int) -> tuple[float, float, float]:
    """Return processor time in s and memory in kB of joining clients, and the s of a poll."""
    with served(root, address, clients, SMALL, 1) as source:
        before, began = memory(), time.process_time()
        source.open()
        spent, taken = time.process_time() - began, memory() - before
        server = source._group.server
        began = time.process_time()
        for _ in range(300):
            server.pump(0.0)
        return spent, taken, (time.process_time() - began) / 300


def joining_alone(address: str, clients: int) -> list[float]:
    """Run `joining` in a new process, whose memory holds nothing else."""
    words = [sys.executable, str(Path(__file__)), address, str(clients)]
    done = subprocess.run(words, stdout=subprocess.PIPE, check=True)
    found: list[float] = json.loads(done.stdout)
    return found


def receiving(
    root: Path, address: str, clients: int, values: int, rows: int, total: int
) -> tuple[float, float]:
    """Return the processor time in s of receiving a row, and of storing it."""
    size = min(total // 5, 10_000)
    receive = store = 0.0
    with (
        Dataset.create(root / f"rows_{secrets.token_hex(4)}") as dataset,
        served(root, address, clients, values, rows, total + size) as source,
    ):
        source.open()
        source.batch(size)
        done = 0
        while done < total:
            began = time.process_time()
            batch = source.batch(size)
            between = time.process_time()
            dataset.append("training", batch, checked=True)
            receive, store = receive + between - began, store + time.process_time() - between
            done += size
    return receive / done, store / done


def asking(root: Path, address: str) -> float:
    """Return the time of a prediction in s, in the fastest of several rounds."""
    count = 300
    services = RunServices(root, Observers([]), lambda batch: batch)
    arguments = {"values": SMALL, "asks": count}
    config = EnvironmentConfig(Asking, env_kwargs=arguments, ip_address=address)
    with ClientSource(config, services, SEED, run_ahead=0) as source:
        source.batch(1)
        moments = [time.perf_counter()]
        for _ in range(9):
            source.batch(1)
            moments.append(time.perf_counter())
    return float(np.diff(moments).min()) / count


def processes(root: Path) -> tuple[float, float]:
    """Return the processor time in s that a client takes to start, and its memory in MB."""
    count = 4
    services = RunServices(root, Observers([]), None)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with ClientSource(EnvironmentConfig("toy/spring", num_clients=count), services, SEED) as source:
        source.batch(count)
        pids = [handle.pid for handle in source._group._handles.values()]
        used = sum(_kilobytes(pid) for pid in pids) / count / 1024
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent / count, used


def partitions(root: Path) -> tuple[float, list[tuple[int, float]]]:
    """Return a partition's bytes in the manifest, and the time of a new one in s.

    The latter for two numbers of existing partitions.
    """
    folder, block = root / "partitions", {"x": np.zeros((340, 5)), "y": np.zeros((340, 1))}
    spent = []
    with Dataset.create(folder, max_file_size=3e-5) as dataset:
        for _ in range(PARTITIONS):
            began = time.process_time()
            dataset.append("training", block)
            spent.append(time.process_time() - began)
    text = (folder / "dataset.json").read_text(encoding="utf-8")
    count = len(json.loads(text)["modes"]["training"]["partitions"])
    few = PARTITIONS // 30
    early, late = spent[few // 2 : few + few // 2], spent[-few:]
    return len(text) / count, [
        (few, float(np.mean(early))),
        (PARTITIONS, float(np.mean(late))),
    ]


def costs(root: Path) -> list[Row]:
    """Measure everything; return names with plain and encrypted costs."""
    os.environ.setdefault("PHYSX_TOKEN", secrets.token_hex(32))
    _be_quiet()
    outside = outside_address()
    places = ["127.0.0.1", *([] if outside is None else [outside])]
    if outside is None:
        print("This machine has no address but the loopback one: nothing is encrypted here.")
    columns = [_column(root, place) for place in places]
    if outside is None:
        columns.append(dict.fromkeys(columns[0], "-"))
    rows = [(name, columns[0][name], columns[1][name]) for name in columns[0]]
    started, used = processes(root)
    entry, grown = partitions(root)
    rows.append(("client process: CPU time from start to end", f"{started:.2f} s", "the same"))
    rows.append(("client process: memory", f"{used:.0f} MB", "the same"))
    rows.append(("manifest: size per partition of 2 fields", f"{entry:.0f} B", "the same"))
    for count, seconds in grown:
        name = f"writer: CPU time of a new partition after {count} others"
        rows.append((name, f"{1e3 * seconds:.1f} ms", "the same"))
    return rows


def _be_quiet() -> None:
    """Suppress the message that a run waits for clients."""
    logging.getLogger("physx").setLevel(logging.ERROR)


def _column(root: Path, address: str) -> dict[str, str]:
    few, many = joining_alone(address, FEW), joining_alone(address, MANY)
    join, kept, look = ((b - a) / (MANY - FEW) for a, b in zip(few, many, strict=True))
    single, _ = receiving(root, address, 8, SMALL, 1, 5000)
    block, store = receiving(root, address, 8, SMALL, 1000, 400_000)
    crowd, _ = receiving(root, address, MANY, SMALL, 1, 5000)
    large, stored = receiving(root, address, 2, LARGE, 2, 2000)
    megabytes = 8e-6 * LARGE
    return {
        "server: CPU time of a client that joins": f"{1e3 * join:.2f} ms",
        "server: memory of an idle client": f"{kept:.0f} kB",
        "server: CPU time of polling for events, added by each idle client": (
            f"{1e6 * max(look, 0):.2f} µs"
        ),
        "server: a frame of one row of 48 B, 8 clients": f"{1e6 * single:.0f} µs",
        f"server: a frame of one row of 48 B, {MANY} clients": f"{1e6 * crowd:.0f} µs",
        "server: a row of 48 B, 1000 in a frame": f"{1e6 * block:.2f} µs",
        "server: storing a row of 48 B": f"{1e6 * store:.2f} µs",
        "server: receiving rows of 48 kB, per MB": f"{1e3 * large / megabytes:.2f} ms",
        "server: storing rows of 48 kB, per MB": f"{1e3 * stored / megabytes:.2f} ms",
        "a prediction for one client, round trip": f"{1e6 * asking(root, address):.0f} µs",
    }


def print_costs(root: Path, page: Path | None) -> None:
    """Print the table, and write it into a page if one is given."""
    lines = ["| | plain | encrypted |", "|---|---|---|"]
    lines += [f"| {what} | {plain} | {encrypted} |" for what, plain, encrypted in costs(root)]
    print("\n".join(lines))
    if page is not None:
        text = page.read_text(encoding="utf-8")
        before, _, rest = text.partition(MARKS[0])
        _, _, after = rest.partition(MARKS[1])
        table = "\n".join([MARKS[0], "", *lines, "", MARKS[1]])
        page.write_text(before + table + after, encoding="utf-8")


def main() -> None:
    """Print what `joining` returns for an address and a number of clients."""
    _be_quiet()
    with tempfile.TemporaryDirectory() as name:
        print(json.dumps(joining(Path(name), sys.argv[1], int(sys.argv[2]))))


if __name__ == "__main__":
    main()
