"""Engines that environments are tested on."""

import pytest


@pytest.fixture(params=["dart", "pinocchio"])
def backend(request):
    return request.param
