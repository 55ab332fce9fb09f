from __future__ import annotations

import pytest

from physx_core import plugins


@pytest.fixture
def backend():
    return plugins.resolve("backend", "mujoco")


@pytest.fixture
def pinocchio():
    return plugins.resolve("backend", "pinocchio")


@pytest.fixture
def dart():
    return plugins.resolve("backend", "dart")
