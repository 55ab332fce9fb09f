"""Power cuts on a real ext4 file system: images are copied while they are written, and mounted."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from sizes import seed, trials

pytestmark = pytest.mark.processes

POWER_CUTS = Path(__file__).parents[1] / "programs" / "power_cuts.py"
WORKS = ["append", "roll-over", "extend", "create", "info", "update", "curate", "checkpoint"]
PROBE = """
set -e
mount -t tmpfs tmpfs .
truncate -s 8M image
mkfs.ext4 -q image
mkdir disk
mount -o loop image disk
fsfreeze -f disk
fsfreeze -u disk
"""


@pytest.fixture(scope="module")
def mounting(tmp_path_factory):
    """Skip where no image can be mounted; continuous integration must be able to."""
    place = tmp_path_factory.mktemp("probe")
    command = ["unshare", "--mount", "sh", "-c", PROBE]
    try:
        done = subprocess.run(command, cwd=place, capture_output=True, text=True)
        problem = done.stderr.strip() if done.returncode else ""
    except FileNotFoundError as error:
        problem = str(error)
    if problem and os.environ.get("CI") == "true":
        pytest.fail(f"images of file systems must be mountable here: {problem}")
    if problem:
        pytest.skip(f"power cuts on ext4 were left out, no image can be mounted: {problem}")


def cut_power(tmp_path, durability, seed, rounds, works):
    """Let a writer for each work lose its power so many times; check what is left each time."""
    arguments = [str(POWER_CUTS), str(tmp_path / "disks"), durability, str(seed), str(rounds)]
    done = subprocess.run(
        ["unshare", "--mount", sys.executable, *arguments, *works], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counts = json.loads(done.stdout.splitlines()[-1])
    assert counts["cuts"] == rounds * len(works) and counts["bad"] == []
    return counts


@pytest.mark.parametrize("durability", ["fast", "durable"])
def test_power_cut_keeps_durable_rows(tmp_path, mounting, durability):
    cut_power(tmp_path, durability, 1, 1, ["append", "roll-over", "extend", "update", "checkpoint"])


@pytest.mark.faults
@pytest.mark.parametrize("durability", ["fast", "durable"])
def test_power_cut_campaign_keeps_durable_rows(
    tmp_path, mounting, record_property, durability
):  # 80 cuts in a full campaign
    record_property("counts", cut_power(tmp_path, durability, seed(), trials(5, 2), WORKS))
