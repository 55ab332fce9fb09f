"""Kills the processes of a sweep, and counts what that cost."""

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path


def start(file, study):
    """Start a sweep, which counts the batches of each trial beside its folder."""
    words = [sys.executable, "-m", "physx_core.cli", "sweep", str(file), "--study", str(study)]
    variables = {**os.environ, "PHYSX_TEST_BATCHES": "1"}
    return subprocess.Popen(words, stderr=subprocess.DEVNULL, env=variables)


def processes(study):
    """Return the process ids of the trials that run, by name."""
    found = {}
    for cmdline in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
        try:
            words = cmdline.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"physx_cluster.sweep.trial" in words and words[0].endswith(b"python"):
            folder = Path(os.fsdecode(words[3]))
            if folder.parent == Path(study).resolve():
                found[folder.name] = int(cmdline.parent.name)
    return found


def batches(folder):
    """Return how many batches a trial was given, those that were lost among them."""
    place = folder.with_name(f"{folder.name}.batches")
    return place.stat().st_size if place.exists() else 0


def stored(folder, per_epoch):
    """Return how many batches the last checkpoint of a trial holds."""
    found = [0]
    for place in folder.glob("network/network_[0-9]*/checkpoint.toml"):
        try:
            progress = tomllib.loads(place.read_text())["progress"]
        except OSError:  # it was removed meanwhile
            continue
        found.append(progress["epoch"] * per_epoch + progress["batch"])
    return max(found)


def sweep_with_kills(file, study, moments, per_epoch, whole=()):
    """Run a sweep, whose trials are killed at some moments, to its end.

    Args:
        file: The study's file.
        study: Its folder.
        moments: Name of a trial to the numbers of batches at which it is killed, in order.
        per_epoch: Number of batches in an epoch.
        whole: How many batches all trials have had when the sweep itself is killed, in order.

    Returns:
        How many batches the kills destroyed, and how many kills there were.
    """
    left = {name: list(numbers) for name, numbers in moments.items()}
    ends, lost, kills = list(whole), 0, 0
    sweep = start(file, study)
    deadline = time.monotonic() + 400
    while sweep.poll() is None:
        assert time.monotonic() < deadline
        for name, pid in processes(study).items():
            folder = Path(study) / name
            if left.get(name) and batches(folder) >= left[name][0]:
                left[name].pop(0)
                kills += 1
                lost += kill(pid, folder, per_epoch)
        done = sum(place.stat().st_size for place in Path(study).glob("*.batches"))
        if ends and done >= ends[0]:
            ends.pop(0)
            kills += 1
            running = [Path(study) / name for name in processes(study)]
            sweep.kill()
            sweep.wait()
            while processes(study):  # the watchdog ends them
                time.sleep(0.01)
            lost += sum(unstored(folder, per_epoch) for folder in running)
            sweep = start(file, study)
        time.sleep(0.005)
    assert sweep.returncode == 0
    return lost, kills


_COUNTED = {}


def kill(pid, folder, per_epoch):
    """Kill the process of a trial; return how many batches that destroyed."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return 0
    while Path(f"/proc/{pid}").exists() and "Z" not in state_of(pid):
        time.sleep(0.001)
    return unstored(folder, per_epoch)


def state_of(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def unstored(folder, per_epoch):
    """Return how many of a trial's batches are in no checkpoint, and were not counted before."""
    total = batches(folder) - stored(folder, per_epoch) - _COUNTED.get(folder, 0)
    _COUNTED[folder] = _COUNTED.get(folder, 0) + total
    return total
