import os

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Sessions are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)
