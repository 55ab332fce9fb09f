"""Checks run in another process, which leaves this one as it is and may crash."""

import pytest

from physx_core.errors import UsageError
from physx_testing import check_environment, check_sampler
from physx_testing.process_state import process_state, unchanged

pytestmark = pytest.mark.processes


@pytest.mark.slow
def test_this_process_stays_as_it_is(place):
    before = process_state()
    with unchanged(before):
        assert not check_environment(place("wrong_environments", "Meddles")).ok


def test_a_module_that_cannot_be_imported_is_a_result(tmp_path, expect_named):
    (tmp_path / "broken.py").write_text("import os\nos._exit(7)\n")
    report = check_environment(f"{tmp_path}/broken.py:Anything")
    expect_named(report, "can be imported and created", "exit status 7")
    (tmp_path / "wrong.py").write_text("raise RuntimeError('no license')\n")
    report = check_environment(f"{tmp_path}/wrong.py:Anything")
    expect_named(report, "can be imported and created", "no license")


def test_a_component_that_needs_options_is_left_out():
    report = check_sampler("physx/table")
    assert not report.ok and report.counts()["skipped"] == 1
    assert "file" in str(report)


class OfThisTest:
    """A class that another process can only find by its file."""


def test_a_class_is_found_by_its_file(expect_named):
    report = check_environment(OfThisTest)
    expect_named(report, "can be imported and created", "is a class that is not derived")


def test_a_class_that_nobody_else_can_find_is_an_error():
    class Local:
        pass

    with pytest.raises(UsageError, match="top level of a module"):
        check_environment(Local)
