"""Child processes and temporary folders go with whoever started them."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from physx_core.processes import ChildProcess, TemporaryFolder
from physx_core.processes.watchdog import WATCHDOG

pytestmark = [pytest.mark.usefixtures("nothing_stays_behind"), pytest.mark.processes]
SLEEP = ["sleep", "60"]


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_closing_ends_the_process_and_those_that_it_started(tmp_path):
    script = f"sleep 60 & echo $! > {tmp_path}/part; mv {tmp_path}/part {tmp_path}/pid; wait"
    with ChildProcess(["sh", "-c", script]) as process:
        wait_until((tmp_path / "pid").exists)
        grandchild = int((tmp_path / "pid").read_text())
        assert process.exit_status() is None and alive(grandchild)
    assert process.exit_status() == -signal.SIGTERM
    wait_until(lambda: not alive(grandchild))
    process.close()


def test_a_process_is_asked_to_end_only_once(tmp_path):
    trap = f"trap 'echo . >> {tmp_path}/asked' TERM"
    script = f"{trap}; touch {tmp_path}/ready; sleep 60 & wait; sleep 1"
    process = ChildProcess(["sh", "-c", script])
    wait_until((tmp_path / "ready").exists)
    process.ask_to_end()
    wait_until((tmp_path / "asked").exists)
    process.ask_to_end()
    process.close()
    assert (tmp_path / "asked").read_text() == ".\n"


def test_a_process_that_ignores_a_polite_signal_is_killed(tmp_path):
    script = f"trap '' TERM; touch {tmp_path}/ready; while true; do sleep 0.05; done"
    process = ChildProcess(["sh", "-c", script])
    wait_until((tmp_path / "ready").exists)
    process.close(patience=0.1)
    assert process.exit_status() == -signal.SIGKILL


def test_what_a_process_leaves_running_ends_with_it():
    process = ChildProcess(["sh", "-c", "sleep 60 & exit 3"])
    assert process.wait(30) == 3
    assert process.exit_status() == 3


def test_its_input_is_empty_and_variables_and_errors_arrive():
    process = ChildProcess(
        ["sh", "-c", 'cat; echo "$GIVEN $HOME" >&2'],
        variables={"GIVEN": "one"},
        stderr=subprocess.PIPE,
    )
    with process.stderr:
        assert process.stderr.read().decode() == f"one {os.environ['HOME']}\n"
    assert process.wait(30) == 0


def test_a_program_that_does_not_exist_is_an_error():
    with pytest.raises(FileNotFoundError, match="nothing-of-that-name"):
        ChildProcess(["nothing-of-that-name"])


def test_an_object_that_nobody_holds_takes_its_process_and_folder_with_it():
    process, folder = ChildProcess(SLEEP), TemporaryFolder("held-")
    pid, path = process.pid, folder.path
    (path / "file").write_text("text")
    assert alive(pid)
    del process, folder
    gc.collect()
    assert not alive(pid) and not path.exists() and not path.parent.exists()


def test_a_folder_is_private_and_goes_when_it_is_closed():
    with TemporaryFolder("one-") as one, TemporaryFolder("two-") as two:
        assert one.path.name.startswith("one-") and two.path.parent == one.path.parent
        assert one.path.stat().st_mode & 0o077 == one.path.parent.stat().st_mode & 0o077 == 0
        one.close()
        assert not one.path.exists() and two.path.exists()
    assert not two.path.parent.exists()
    two.close()


def test_a_process_that_cannot_be_watched_over_never_begins(tmp_path, monkeypatch, children):
    def fail(group):
        raise MemoryError

    before = children()
    with monkeypatch.context() as patch:
        patch.setattr(WATCHDOG, "add", fail)
        with pytest.raises(MemoryError):
            ChildProcess(["touch", str(tmp_path / "began")])
    gc.collect()
    process = ChildProcess(["true"])  # starting another one reaps the first
    assert process.wait(30) == 0
    time.sleep(0.1)
    assert not list(tmp_path.iterdir())
    assert children() <= before


def test_a_watchdog_that_somebody_killed_is_replaced(tmp_path):
    owner = start(tmp_path, "one = ChildProcess(['sleep', '60'])", f"{KILL_THE_SHELL}", PRINT_TWO)
    pids = [int(word) for word in owner.stdout.readline().split()]
    assert all(map(alive, pids)) and len(pids) == 2
    owner.kill()
    owner.communicate()
    wait_until(lambda: not any(map(alive, pids)))


def test_a_watchdog_that_is_told_to_end_stays(tmp_path):
    tell = KILL_THE_SHELL.replace("-KILL", "-TERM")
    owner = start(tmp_path, "one = ChildProcess(['sleep', '60'])", tell, PRINT_ONE)
    pid = int(owner.stdout.readline())
    assert alive(pid)
    owner.kill()
    owner.communicate()
    wait_until(lambda: not alive(pid))


HEAD = """
import os, signal, subprocess, sys, time
from physx_core.processes import ChildProcess, TemporaryFolder
"""
KILL_THE_SHELL = """
subprocess.run(["pkill", "-KILL", "-P", str(os.getpid()), "-f", "physx-watchdog"], check=True)
time.sleep(0.1)
"""
PRINT_ONE = "print(one.pid, flush=True); time.sleep(60)"
PRINT_TWO = (
    "two = ChildProcess(['sleep', '60']); print(one.pid, two.pid, flush=True); time.sleep(60)"
)


def start(folder, *lines):
    (folder / "owner.py").write_text(HEAD + "\n".join(lines))
    return subprocess.Popen(
        [sys.executable, str(folder / "owner.py")],
        stdout=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(folder)},
    )


FORKED = """
child, folder = ChildProcess(["sleep", "60"]), TemporaryFolder("held-")
if os.fork() == 0:
    own = ChildProcess(["sleep", "60"])
    child.close()
    folder_there = folder.path.exists()
    print(os.getpid(), own.pid, child.pid, folder_there, flush=True)
    time.sleep(60)
os.wait()
"""


def test_a_forked_process_neither_ends_nor_holds_what_its_parent_started(tmp_path):
    owner = start(tmp_path, FORKED)
    forked, own, child, there = owner.stdout.readline().split()
    assert there == b"True" and all(map(alive, map(int, (forked, own, child))))
    owner.kill()
    owner.wait()
    wait_until(lambda: not alive(int(child)))
    assert alive(int(forked)) and alive(int(own))  # the forked process is the user's own
    os.kill(int(forked), signal.SIGKILL)
    wait_until(lambda: not alive(int(own)))
    owner.stdout.close()
    wait_until(lambda: [path.name for path in tmp_path.iterdir()] == ["owner.py"])


def _close(process, folder):
    process.close()
    folder.close()


def test_a_forked_process_of_multiprocessing_may_close_them_without_effect():
    with ChildProcess(SLEEP) as process, TemporaryFolder("held-") as folder:
        context = multiprocessing.get_context("fork")
        forked = context.Process(target=_close, args=(process, folder))
        forked.start()
        forked.join(60)
        assert forked.exitcode == 0
        assert process.exit_status() is None and alive(process.pid) and folder.path.exists()
        forked.close()


def test_one_that_is_to_live_on_does(tmp_path):
    line = "print(ChildProcess(['sleep', '60'], detached=True).pid, flush=True)"
    owner = start(tmp_path, line, "ChildProcess(['true']).wait()")
    pid = int(owner.stdout.readline())
    assert owner.wait(60) == 0
    owner.stdout.close()
    time.sleep(0.2)
    assert alive(pid)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not alive(pid))


def test_all_descendants_are_killed_and_their_files_removed(tmp_path):
    lines = (
        "from physx_core.processes import kill_descendants",
        "subprocess.Popen(['sleep', '60'], start_new_session=True)",
        "child, folder = ChildProcess(['sleep', '60']), TemporaryFolder('held-')",
        "kill_descendants()",
        "kill_descendants()  # there are none any more",
        "print(child.exit_status(), folder.path.exists())",
    )
    owner = start(tmp_path, *lines)
    assert owner.communicate(timeout=60)[0] == b"-9 False\n"
    assert [path.name for path in tmp_path.iterdir()] == ["owner.py"]
