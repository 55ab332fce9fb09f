import pytest


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Sessions are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)
