"""A lock that ends with its process."""

import subprocess
import sys

import pytest

from physx_core import files

HOLD = "import sys; from physx_core import files; print(files.try_lock(sys.argv[1])); input()"


def test_a_lock_is_held_by_one_and_ends_with_its_process(tmp_path):
    path = tmp_path / "lock"
    words = [sys.executable, "-c", HOLD, str(path)]
    holder = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout.readline().strip().isdigit()
    assert files.try_lock(path) is None
    holder.kill()
    holder.communicate()
    lock = files.try_lock(path)
    assert lock is not None
    assert files.try_lock(path) is None
    files.close(lock)
    again = files.try_lock(path)
    files.close(again)


def test_a_link_is_not_locked(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with pytest.raises(OSError, match="not a regular file"):
        files.try_lock(tmp_path / "link")
