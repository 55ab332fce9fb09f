"""What the tests of the kits share."""

from pathlib import Path

import pytest

PROGRAMS = Path(__file__).with_name("programs")


@pytest.fixture
def place():
    """The function that returns the reference of a component in a file of programs/."""
    return lambda file, name: f"{PROGRAMS / file}.py:{name}"


@pytest.fixture
def expect_named():
    """The function that expects that a check failed, with a text in its reason."""

    def expect(report, name, text):
        failed = {check.name: check.reason for check in report.checks if check.status == "failed"}
        assert not report.ok
        assert name in failed, str(report)
        assert text in failed[name], failed[name]
        assert name in str(report) and text in str(report)

    return expect


@pytest.fixture
def expect_right():
    """The function that expects that nothing was found."""

    def expect(report):
        assert report.ok, str(report)
        assert report.counts()["passed"] >= 7, str(report)

    return expect


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Sessions are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)
