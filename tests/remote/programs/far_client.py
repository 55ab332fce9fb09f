"""A client on another machine: ``far_client.py PROTOCOL ADDRESS idle|busy|waiting``.

It says ``ready`` once it is served, and how it ended. Its requests may take forever.
"""

from __future__ import annotations

import sys
import time

from physx_remote import connect
from physx_remote.errors import RemoteError

protocol, address, what = sys.argv[1:]
env = connect(address, protocol, timeout=None)
quick, slow = env.action_space.low, env.action_space.high
env.reset()
env.step(quick)
print("ready", flush=True)
try:
    if what == "idle":
        time.sleep(600)
    if what == "waiting":
        env.step(slow)
    while True:
        env.step(quick)
except RemoteError as error:
    print(f"{type(error).__name__}: {error}", flush=True)
