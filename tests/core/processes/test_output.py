"""The last lines of a process's output, in a file that it shares."""

import subprocess
import sys

import pytest

from physx_core.processes import OutputFile

pytestmark = pytest.mark.processes

WRITES = """
import sys
for number in range(int(sys.argv[1])):
    print(number, "x" * 100, file=sys.stderr)
"""


def write(file, lines):
    command = [sys.executable, "-c", WRITES, str(lines)]
    subprocess.run(command, stderr=file.descriptor, check=True)


def test_a_file_returns_the_last_lines_and_is_trimmed_while_it_is_written():
    with OutputFile(lines=3) as file:
        assert file.text() == ""
        write(file, 20_000)
        last = [text.split()[0] for text in file.text().splitlines()]
        assert last == ["19997", "19998", "19999"]
        file.trim()
        write(file, 1)
        assert [text.split()[0] for text in file.text().splitlines()] == ["19998", "19999", "0"]
        assert len(file.text()) < 400
