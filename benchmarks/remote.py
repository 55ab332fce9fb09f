"""Environments in another process against raw sockets, and many worlds against single requests.

Candidates run alternately, in one run. Starting processes is not timed.

    python benchmarks/remote.py
    python benchmarks/remote.py --check     # ends with status 1 if a target is missed
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import secrets
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from cores import on_core, two_cores
from measure import claim, finish, rates, report
from remote_servers import ACTION, messages

from physx_remote import GodotGymClient, PhysxClient, PhysxEnv, PhysxVectorEnv

ROUNDS = 15
FEW_STEPS = 4
STEPS_OF_1_MS = 17
REQUESTS = 400
WORLDS = 16
STEPS = 40
SERVERS = Path(__file__).with_name("remote_servers.py")
WANTED = {"agent": ["positions", "velocities"], "world": ["done"]}


@contextlib.contextmanager
def process(*words: str, core: int | None = None) -> Iterator[str]:
    """Run a server in another process; yield the first line that it prints.

    Args:
        words: What Python runs.
        core: The only processor core that it may use; None: any.
    """
    server = subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        if core is not None:
            os.sched_setaffinity(server.pid, {core})
        yield server.stdout.readline() if server.stdout is not None else ""
    finally:
        server.terminate()
        server.wait()


def served(*words: str, core: int | None = None) -> contextlib.AbstractContextManager[str]:
    """Run ``physx serve`` in another process; yield the line that says where it listens."""
    return process("-m", "physx_core.cli", "serve", *words, "--port", "0", core=core)


def place_of(line: str) -> tuple[str, int]:
    """Return host and port at the end of a line."""
    host, _, port = line.split()[-1].rpartition(":")
    return host, int(port)


def raw_round_trip(port: int, request: bytes, answer: int) -> Callable[[], object]:
    """Return a function that exchanges the same bytes as godot-gym and ignores their content."""
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def ask() -> None:
        connection.sendall(request)
        received = 0
        while received < answer:
            received += len(connection.recv(1 << 16))

    return ask


def latency(ask: Callable[[], object]) -> float:
    """Return the median time of a request, in s.

    A mean would also reflect the other programs on this machine.
    """
    moments = [time.perf_counter()]
    for _ in range(REQUESTS):
        ask()
        moments.append(time.perf_counter())
    return statistics.median(after - before for before, after in itertools.pairwise(moments))


def godot_gym(steps: int, cores: list[int]) -> float:
    """Compare steps over godot-gym with raw round trips and the same physics in between.

    Args:
        steps: Physics steps in a frame of 1/60 s.
        cores: Processor cores of this process and of the servers, one each; empty: any.

    Returns:
        How many times as long a step over godot-gym takes.
    """
    request = json.dumps({"action": ACTION, "observation": WANTED}).encode()
    core = cores[1] if cores else None
    with contextlib.ExitStack() as stack:
        stack.enter_context(on_core(cores[0] if cores else None))
        words = [f"{SERVERS}:Small", "--protocol", "godot-gym", "--env-kwargs", f"steps={steps}"]
        line = stack.enter_context(served(*words, core=core))
        client = stack.enter_context(GodotGymClient(messages(), place_of(line)))
        client.set_repeat_action(1)
        client.reset(WANTED)
        sizes = 4 + len(request), _answer_size(client)
        ports = {
            name: int(stack.enter_context(process(str(SERVERS), *map(str, sizes), n, core=core)))
            for name, n in (("raw", "0"), ("raw and physics", str(steps)))
        }

        candidates = {
            name: raw_round_trip(port, bytes(sizes[0]), sizes[1]) for name, port in ports.items()
        }
        candidates["godot-gym"] = lambda: client.step(ACTION, WANTED)
        measured: dict[str, list[float]] = {name: [] for name in candidates}
        for _ in range(ROUNDS):
            for name, ask in candidates.items():
                measured[name].append(latency(ask))
    where = "each process on a core of its own" if cores else "on cores of the kernel's choice"
    print(f"godot-gym over DART, {steps} physics steps in the one frame of each action, {where}")
    print(f"  {sizes[0]} bytes there, {sizes[1]} back")
    for name, each in measured.items():
        print(f"  {name:28} {1e6 * statistics.median(each):8,.0f} µs")
    pairs = zip(measured["raw and physics"], measured["godot-gym"], strict=True)
    return statistics.median(mine / raw for raw, mine in pairs)


def _answer_size(client: GodotGymClient) -> int:
    """Return the size of the server's answer in bytes."""
    told = client.step(ACTION, WANTED)
    agent = told["agent"] or {}
    message = messages().Message(
        agent_data={name: values.tolist() for name, values in agent.items()},
        world_data={"done": False},
    )
    return 4 + len(message.SerializeToString())


def all_godot_gym() -> bool:
    """Measure godot-gym; the claim is about physics steps of 1 ms and one core per process.

    Client and server work alternately. If nothing else runs, the kernel puts raw sockets on one
    core: there, a round trip takes 16 us, about as long as Python takes to read one JSON request,
    fill one message and read it. With few physics steps per frame, that is most of what is
    measured.
    """
    cores = two_cores()
    for steps, where in ((FEW_STEPS, cores), (STEPS_OF_1_MS, [])):
        ratio = godot_gym(steps, where)
        print(f"  {ratio:.2f} times as long as raw and physics there, without a target\n")
    ratio = godot_gym(STEPS_OF_1_MS, cores)
    return claim("godot-gym takes as many times as long as raw and physics", ratio, at_most=1.9)


def worlds_together(environment: str, target: float) -> bool:
    """Compare one request for all worlds with single requests, on one connection."""
    with contextlib.ExitStack() as stack:
        line = stack.enter_context(served(environment, "--num-worlds", str(WORLDS)))
        client = stack.enter_context(PhysxClient(place_of(line)))
        together = PhysxVectorEnv(client)
        single = [PhysxEnv(client, world) for world in range(WORLDS)]
        actions = np.ones(WORLDS, np.int64)

        def one_request() -> Iterator[int]:
            together.reset(seed=0)
            yield 0
            for step in range(STEPS):
                actions[:] = step % 2
                together.step(actions)
            yield STEPS * WORLDS

        def single_requests() -> Iterator[int]:
            together.reset(seed=0)
            yield 0
            over = [False] * WORLDS
            for step in range(STEPS):
                for world, env in enumerate(single):
                    over[world] = _one_step(env, over[world], step % 2)
            yield STEPS * WORLDS

        candidates: dict[str, Any] = {
            "16 single requests": single_requests,
            "16 worlds in one request": one_request,
        }
        measured = rates(candidates, ROUNDS)
    return report(
        f"{environment}, {WORLDS} worlds on one connection of the protocol physx",
        "steps", measured, "16 single requests", target, "16 worlds in one request",
    )  # fmt: skip


def _one_step(env: PhysxEnv, over: bool, action: int) -> bool:
    if over:
        env.reset()
        return False
    _, _, terminated, truncated, _ = env.step(action)
    return terminated or truncated


def main() -> None:
    """Measure everything."""
    os.environ["PHYSX_TOKEN"] = secrets.token_hex(32)
    finish([all_godot_gym(), worlds_together("gym/CartPole-v1", 5.0)])


if __name__ == "__main__":
    main()
