"""What several files share: a folder and a dataset, and sources of the environments beside this."""

from __future__ import annotations

import os
import socket
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest

from physx_core import Dataset
from physx_core.config import EnvironmentConfig
from physx_core.sources.clients import ClientSource
from physx_core.sources.local import LocalSource

SEED = [5, 0, 7]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Sessions are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)


# Datasets ---------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


@pytest.fixture
def dataset(folder):
    with Dataset.create(folder, max_file_size=0.001) as dataset:
        yield dataset


# Sources ----------------------------------------------------------------------------------------


class Services:
    """Keeps what environments ask for; the prediction doubles x."""

    def __init__(self):
        self.kept, self.shown, self.asked = {}, [], []

    def predict(self, fields):
        self.asked.append(1)
        return {"y": 2 * np.asarray(fields["x"])}

    def save_parameters(self, instance_id, values):
        self.kept[instance_id] = values

    def load_parameters(self, instance_id):
        return self.kept.get(instance_id, {})

    def show(self, instance_id, step, events):
        self.shown.append((instance_id, step, events))


def configured(environment, options):
    if isinstance(environment, str) and environment.isidentifier():
        environment = f"{Path(__file__).with_name('transport_envs.py')}:{environment}"
    return EnvironmentConfig(environment, **options)


@pytest.fixture
def services():
    """What the sources of this test ask."""
    return Services()


@pytest.fixture
def local(services):
    """Return the source of an environment in this process; a plain name is in transport_envs.py."""

    def make(environment, **options):
        return LocalSource(configured(environment, options), services, SEED)

    return make


@pytest.fixture
def clients(services, nothing_stays_behind):
    """Return the source of an environment in client processes, named as for `local`."""

    def make(environment="Plain", *, run_ahead=None, total=None, **options):
        settings = configured(environment, options)
        return ClientSource(settings, services, SEED, run_ahead=run_ahead, total=total)

    return make


@pytest.fixture
def port():
    """A port where nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
