from __future__ import annotations

import pytest

from physx_core import plugins


@pytest.fixture
def backend():
    from physx_mujoco.simulation import MujocoBackend

    return MujocoBackend()


@pytest.fixture
def pinocchio():
    return plugins.resolve("backend", "pinocchio")


@pytest.fixture
def dart():
    return plugins.resolve("backend", "dart")
