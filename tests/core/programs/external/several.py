"""Starts a program several times, as an MPI launcher does: several.py COUNT PROGRAM [WORD...].

Each gets its RANK. If one fails, the others are ended.
"""

import os
import subprocess
import sys
import time

count, command = int(sys.argv[1]), sys.argv[2:]
ranks = [subprocess.Popen(command, env={**os.environ, "RANK": str(n)}) for n in range(count)]
status = 0
while not status and any(rank.poll() is None for rank in ranks):
    time.sleep(0.01)
    status = next((rank.returncode for rank in ranks if rank.returncode), 0)
for rank in ranks:
    rank.kill()
    status = status or rank.wait()
sys.exit(abs(status))
