"""Runs a program in forks of this process, which has imported what it needs.

Called by ``python forks.py PROGRAM``; each line of the input says of one run, in JSON, in which
folder it is, after how many seconds it is killed (or null), and its arguments; each line of the
output, after a first one, is its exit status.
"""

from __future__ import annotations

import json
import os
import runpy
import select
import signal
import sys

import h5py  # noqa: F401
from scipy.stats import qmc  # noqa: F401

from physx_core import *  # noqa: F403
from physx_core.buffers import *  # noqa: F403
from physx_core.samplers import *  # noqa: F403
from physx_core.sources import *  # noqa: F403

PROGRAM = sys.argv[1]

print("ready", flush=True)
for line in sys.stdin:
    folder, seconds, *words = json.loads(line)
    if not (child := os.fork()):
        os.chdir(folder)
        sys.argv = [PROGRAM, *words]
        runpy.run_path(PROGRAM, run_name="__main__")
        break
    ended = os.pidfd_open(child)
    if not select.select([ended], [], [], seconds)[0]:
        os.kill(child, signal.SIGKILL)
    os.close(ended)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
