"""The launcher of Ray keeps the contract of launchers."""

import tempfile

import pytest

from physx_core.testing import check_launcher

pytestmark = pytest.mark.slow


def test_ray_keeps_the_contract(monkeypatch, nothing_stays_behind):
    pytest.importorskip("ray")
    with tempfile.TemporaryDirectory(
        prefix="ray", dir="/tmp", ignore_cleanup_errors=True
    ) as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)  # so that it does not find a Ray of other tests
        report = check_launcher("cluster/ray")
    assert report.ok and report.counts()["skipped"] == 0, str(report)
