"""The launchers of clusters keep the contract of launchers: Ray on this machine, and submitit's."""

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
        _check_ray()


def _check_ray():
    report = check_launcher("cluster/ray")
    assert report.ok and report.counts()["skipped"] == 0, str(report)


def test_jobs_of_submitit_keep_the_contract(tmp_path, nothing_stays_behind):
    pytest.importorskip("submitit")
    report = check_launcher("cluster/slurm", cluster="local", folder=str(tmp_path))
    assert report.ok and report.counts()["skipped"] == 0, str(report)
