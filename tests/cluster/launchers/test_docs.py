"""The page about clusters: its three commands, with two nodes on this machine."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from one_node_slurm import free_ports

pytest.importorskip("ray")

pytestmark = [pytest.mark.faults, pytest.mark.processes]

PAGE = Path(__file__).parents[3] / "docs" / "cluster.md"


def test_three_commands_lead_to_two_nodes(runs, local_rows):
    text = PAGE.read_text(encoding="utf-8")
    block = re.search(r"three_commands.*?```sh\n(.*?)```", text, re.S)[1]
    head, other, generate = (
        line.partition("  #")[0].split() for line in block.replace("\\\n", " ").splitlines()
    )
    expected = local_rows()
    folder, [port] = tempfile.mkdtemp(prefix="ray", dir="/tmp"), free_ports(1)
    place = f"127.0.0.1:{port}"
    own = {"RAY_TMPDIR": folder, "HOME": folder}  # in the user's home Ray may have a token
    variables = {**os.environ, **own}

    def ray(*words):
        program = [sys.executable, "-c", "from ray.scripts.scripts import main; main()"]
        done = subprocess.run(
            [*program, *words[1:]], env=variables, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stdout + done.stderr

    one = ("--num-cpus", "1", "--include-dashboard", "false", "--temp-dir", folder)
    try:
        ray(*(word.replace("6379", str(port)) for word in head), *one)
        ray(*(word.replace("LAPTOP:6379", place) for word in other), "--num-cpus", "1")
        words = generate[generate.index("--environment.launcher") :]
        launcher = words[: words.index("--environment.num-clients")]
        assert runs.same(runs.rows(*launcher, **own), expected)
        assert len(runs.clients()) == 2
    finally:
        end_processes_with(folder)
        shutil.rmtree(folder, ignore_errors=True)


def end_processes_with(text):
    """Kill the processes on whose command lines a text stands: `ray stop` would end all of Ray."""
    for entry in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
        try:
            if text.encode() in entry.read_bytes():
                os.kill(int(entry.parent.name), 9)
        except OSError:
            continue
