"""The launcher of Slurm keeps the contract of launchers, with submitit's local executor."""

import pytest

from physx_testing import check_launcher

pytestmark = pytest.mark.processes

pytest.importorskip("submitit")


@pytest.mark.faults
def test_jobs_of_submitit_keep_the_contract(tmp_path, nothing_stays_behind):
    report = check_launcher("cluster/slurm", cluster="local", folder=str(tmp_path))
    assert report.ok and report.counts()["skipped"] == 0, str(report)
    assert not list(tmp_path.iterdir())
