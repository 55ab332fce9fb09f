"""Runs a command; then writes its status, the seconds of processor time, and the peak memory."""

import json
import os
import sys
from pathlib import Path

own, *words = sys.argv[1:]
process = os.posix_spawnp(words[0], words, os.environ)
_, status, usage = os.wait4(process, 0)
found = {
    "status": os.waitstatus_to_exitcode(status),
    "seconds": usage.ru_utime + usage.ru_stime,
    "bytes": usage.ru_maxrss * 1024,
}
Path(own).write_text(json.dumps(found), encoding="utf-8")
