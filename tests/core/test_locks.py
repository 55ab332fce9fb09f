"""A lock that ends with its process."""

import os
import subprocess
import sys

import pytest

from physx_core import files

pytestmark = pytest.mark.processes

HOLD = (
    "import sys; from physx_core import files; l = files.try_lock(sys.argv[1]); print(1); input()"
)


def test_a_lock_is_held_by_one_and_ends_with_its_process(tmp_path):
    path = tmp_path / "lock"
    words = [sys.executable, "-c", HOLD, str(path)]
    holder = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout.readline().strip() == b"1"
    assert files.try_lock(path) is None
    holder.kill()
    holder.communicate()
    lock = files.try_lock(path)
    assert lock is not None
    assert files.try_lock(path) is None
    lock.close()
    lock.close()
    with files.try_lock(path):
        assert files.try_lock(path) is None


def test_a_forked_process_neither_keeps_nor_releases_a_lock(tmp_path):
    path = tmp_path / "lock"
    lock = files.try_lock(path)
    assert not run_forked(lock.close)
    assert files.try_lock(path) is None
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(writing)
        os.read(reading, 1)
        os._exit(0)
    lock.close()
    with files.try_lock(path) as again:
        assert again is not None
    os.close(writing)
    os.close(reading)
    os.waitpid(child, 0)


def run_forked(work):
    """Call a function in a forked process; return the exit status."""
    child = os.fork()
    if not child:
        try:
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitpid(child, 0)[1]


def test_a_link_is_not_locked(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with pytest.raises(OSError, match="not a regular file"):
        files.try_lock(tmp_path / "link")
