"""Clients on another machine, started by hand.

The run waits until clients connect. Each client is one command on any machine with physx: `physx
client`, with the address and a file that holds the run's secret token. Connections between machines
are encrypted, and clients prove that they know the token before anything else is exchanged. The
rows are bit-identical to those of a run in one process. Here, the command runs in two other
processes; with --elsewhere it is printed, for you to run where you like.

    python examples/17_two_machines.py
    python examples/17_two_machines.py --elsewhere --port 7341
"""

from __future__ import annotations

import secrets
import shlex
import socket
import subprocess
import sys

import numpy as np
from common import options, samples
from matplotlib.figure import Figure

from physx_core import DataGeneration, EnvironmentConfig

CLIENTS = 2


def draw(path, instances, states) -> None:
    axes = (figure := Figure(figsize=(6, 4.2), layout="constrained")).subplots()
    for instance in range(1, CLIENTS + 1):
        axes.plot(*states[instances == instance].T, ".-", lw=0.7, label=f"client {instance}")
    axes.set(xlabel="position in m", ylabel="velocity in m/s")
    axes.legend()
    figure.savefig(path)


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--elsewhere", action="store_true", help="start no clients here")
    parser.add_argument("--port", type=int, help="by default a free one")
    asked = parser.parse_args()
    asked.session_dir.mkdir(parents=True, exist_ok=True)
    token = asked.session_dir / "token"
    token.touch(mode=0o600)  # only you can read it
    token.write_text(secrets.token_hex())
    run = {"batch_nb": 4 if asked.small else 20, "batch_size": 50, "session_name": "spring"}

    here = "127.0.0.1"
    with socket.create_server((here, 0)) as found:
        port = asked.port or found.getsockname()[1]
    host = socket.gethostname() if asked.elsewhere else here
    command = ["client", "--connect", f"{host}:{port}", "--token-file", str(token)]
    print(f"on the other machine, {CLIENTS} times:\n  physx {shlex.join(command)}", flush=True)
    words = [sys.executable, "-m", "physx_core", *command]
    clients = [] if asked.elsewhere else [subprocess.Popen(words) for _ in range(CLIENTS)]

    by_hand = {"launcher": "physx/manual", "port": port, "token_file": str(token)}
    by_hand["ip_address"] = "0.0.0.0" if asked.elsewhere else here
    sessions = []
    for more in (by_hand, {"as_tcp_ip_client": False}):
        config = EnvironmentConfig("toy/spring", num_clients=CLIENTS, seed=0, **more)
        generation = DataGeneration(config, session_dir=str(asked.session_dir), **run)
        generation.execute()
        sessions.append(generation.session.path)
    ended = [client.wait(60) for client in clients]

    fields = ("env_id", "state", "force", "next_state")
    found, alone = (samples(session, "training", *fields) for session in sessions)
    same = all(np.array_equal(*each) for each in zip(found, alone, strict=True))
    print(f"{len(found[0])} rows of the instances {np.unique(found[0])}, as in one process: {same}")
    if asked.picture:
        draw(asked.picture, *found[:2])
    return int(not same or any(ended))


if __name__ == "__main__":
    sys.exit(main())
