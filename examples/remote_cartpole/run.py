"""A cartpole in another process, over the protocol physx: authenticated, with seeds and snapshots.

Prints for how long a simple rule keeps the pole up: ``python examples/remote_cartpole/run.py``.
"""

import os
import secrets
import subprocess
import sys

from physx_remote import connect

os.environ["PHYSX_TOKEN"] = secrets.token_hex(32)  # the server inherits it
words = [sys.executable, "-m", "physx_core.cli", "serve", "physx/Cartpole-v0"]
with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
    address = server.stdout.readline().split()[-1]
    with connect(address) as pole:
        observation, _ = pole.reset(seed=1)
        begin, total, over = pole.snapshot(), 0.0, False
        while not over:
            push = 2 if observation[1] + observation[3] > 0 else 0
            observation, reward, over, truncated, _ = pole.step(push)
            total, over = total + reward, over or truncated
        print(f"The pole stood for {total:.0f} steps.")
        print("Back at the begin:", pole.restore(begin))
    server.terminate()
