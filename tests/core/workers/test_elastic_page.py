"""The commands of docs/elastic.md: two clients join a run that others started, and its rows."""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
from pathlib import Path

import pytest

from physx_core import Dataset

pytestmark = pytest.mark.processes

PAGE = Path(__file__).parents[3] / "docs" / "elastic.md"
ALONE = """physx generate toy/spring --environment.num-clients 4 --environment.seed 1 \
--batch-nb 20 --batch-size 50"""


@pytest.mark.faults
def test_the_commands_of_the_page_make_the_rows_of_a_run_alone(port, nothing_stays_behind):
    commands = re.search(r"```sh\n(.*?)```", PAGE.read_text(), re.S)[1].replace("5000", str(port))
    path = f"{sysconfig.get_path('scripts')}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euc", f"{commands}\n{ALONE}"],
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "running instance 4, 4 in total" in done.stdout
    assert "(at most 8 may join)" in done.stderr
    found = []
    for path in sorted(Path("sessions").iterdir()):
        with Dataset.open(path) as dataset:
            names = sorted(dataset.fields("training"))
            found.append({name: dataset["training"][name][:].tobytes() for name in names})
            assert dataset.num_samples("training") == 1000
    assert len(found) == 2
    assert found[0] == found[1]
