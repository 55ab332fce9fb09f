"""OpenMP's threads rest soon, unless the user chose otherwise."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes

CHOSEN = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")


def spins(module, **variables):
    """Return what a process finds in its environment once it has imported a module."""
    plain = {name: value for name, value in os.environ.items() if name not in CHOSEN}
    program = f"import os, {module}; print(os.environ.get('GOMP_SPINCOUNT'))"
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, env={**plain, **variables}, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize("module", ["physx_gym", "physx_torch"])
def test_threads_rest_soon(module):
    pytest.importorskip(module)
    assert spins(module) == "30000"


def test_what_the_user_chose_stays():
    assert spins("physx_gym", GOMP_SPINCOUNT="7") == "7"
    assert spins("physx_gym", OMP_WAIT_POLICY="ACTIVE") == "None"


def test_the_core_alone_changes_nothing():
    assert spins("physx_core") == "None"
