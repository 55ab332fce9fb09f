"""Episodes while another process writes them, and after it was killed."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from physx_core import Dataset
from physx_core.dataset import EpisodeRecord

pytestmark = pytest.mark.processes


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


def read(dataset):
    return dataset["training"]["x"][:].tolist()


def test_rows_of_a_writer_that_is_killed_count_with_their_record_only(folder):
    program = f"""
import numpy as np, os, signal
from physx_core import Dataset
from physx_core.dataset import EpisodeRecord, EpisodeStatus
dataset = Dataset.create({str(folder)!r})
dataset.append("training", {{"x": np.arange(3.0)}})
dataset.append_episodes("training", {{"x": np.array([10.0, 11.0])}}, [
    EpisodeRecord(episode=1, rows=1),
    EpisodeRecord(episode=0, rows=1, status=EpisodeStatus.MORE),
])
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = subprocess.run([sys.executable, "-c", program], check=False)
    assert ended.returncode == -signal.SIGKILL
    with Dataset.open(folder) as dataset:
        assert read(dataset) == [0, 1, 2, 10]
    with Dataset.open(folder, writable=True) as dataset:
        record = EpisodeRecord(episode=0, rows=1, part=1)
        dataset.append_episodes("training", {"x": np.array([12.0])}, [record])
        assert read(dataset) == [0, 1, 2, 11, 12, 10]


def test_beside_a_writer_only_numbers_before_the_first_missing_one_count(folder):
    program = f"""
import numpy as np, sys
from physx_core import Dataset
from physx_core.dataset import EpisodeRecord
dataset = Dataset.create({str(folder)!r})
for line in sys.stdin:
    episode = int(line)
    rows = {{"x": np.full(2, float(episode))}}
    dataset.append_episodes("training", rows, [EpisodeRecord(episode=episode, rows=2)])
    print("stored", flush=True)
"""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", program], **pipes) as process:

        def write(episode):
            process.stdin.write(f"{episode}\n")
            process.stdin.flush()
            assert process.stdout.readline() == "stored\n"

        write(2)
        write(0)
        with Dataset.open(folder) as reader:
            assert read(reader) == [0, 0]
            write(3)
            reader.refresh()
            assert read(reader) == [0, 0]
            write(1)
            reader.refresh()
            assert read(reader) == [0, 0, 1, 1, 2, 2, 3, 3]
            write(5)
            reader.refresh()
            assert len(read(reader)) == 8
            process.stdin.close()
            process.wait()
            reader.refresh()
            assert read(reader) == [0, 0, 1, 1, 2, 2, 3, 3, 5, 5]
