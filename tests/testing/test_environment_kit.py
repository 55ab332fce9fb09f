"""The kit names what is wrong with environments, and finds nothing in a right one."""

import pytest

from physx_testing import check_environment

pytestmark = pytest.mark.processes

STEPS = "gives every field in each step, finite and of its shape and type"
CONTINUES = "continues from its state in another process"
WRONG = [
    ("GlobalRandom", "leaves its process as it was", "NumPy's global random numbers"),
    ("Unseeded", "gives the same rows with the same seed", '"state"'),
    ("Shared", "does not disturb another instance", "attribute of the class"),
    ("NotFinite", STEPS, "step 3"),
    ("OtherShape", STEPS, "(3,)"),
    (
        "MissingField",
        STEPS,
        "count",
    ),
    ("Swallows", "refuses unknown options", "misspelling"),
    ("FirstForEver", "takes its place among the instances", "instance 1 of 1"),
    ("DrawsRandomly", "draws without an effect on its rows", "with a visualizer"),
    ("ClosesOnce", "closes at any time, even twice", "before create()"),
    ("Crashes", "gives the same rows with the same seed", "SIGSEGV"),
    ("ReplaysAnything", "replays stored rows", "second replay"),
    ("Forgets", CONTINUES, "row 1 differs in another process that got the state after 1 rows"),
    ("CreatesRandomly", CONTINUES, "after creation, these attributes differ: drift"),
    ("OtherInClients", "gives the same rows from clients over TCP", '"state"'),
]


@pytest.mark.parametrize(("name", "check", "text"), WRONG)
def test_what_is_wrong_is_named(name, check, text, place, expect_named):
    expect_named(check_environment(place("wrong_environments", name)), check, text)


@pytest.mark.slow
def test_all_that_it_did_to_its_process_is_named(place, expect_named):
    report = check_environment(place("wrong_environments", "Meddles"))
    for text in (
        *("the working directory", "the umask", "temporary files", "MEDDLED", "SIGUSR1"),
        "child processes",
    ):
        expect_named(report, "leaves its process as it was", text)


def test_nothing_is_found_in_a_right_one(place, expect_right):
    expect_right(check_environment(place("wrong_environments", "Right")))


@pytest.mark.slow
def test_a_check_that_hangs_ends(place, expect_named):
    report = check_environment(place("wrong_environments", "Hangs"), timeout=8.0)
    expect_named(report, "draws without an effect on its rows", "had not ended after 8 s")
    assert report.counts()["failed"] == 1, str(report)


def test_what_is_the_same_for_all_seeds_is_said_and_not_judged(place):
    report = check_environment(place("wrong_environments", "Constant"))
    assert report.ok
    assert "draw from self.rng" in str(report)


def test_what_needs_a_network_is_left_out(place):
    report = check_environment(place("wrong_environments", "Asks"))
    assert report.ok and report.counts()["skipped"] >= 6, str(report)
    assert "a network, which the kit lacks" in str(report)


def test_what_has_no_state_is_named_and_not_judged(place):
    report = check_environment(place("wrong_environments", "Holds"))
    assert report.ok and report.counts()["skipped"] >= 2, str(report)
    assert "Holds.lock (_thread.lock) cannot be captured" in str(report)


def test_a_state_that_disturbs_is_said_and_not_judged(place):
    report = check_environment(place("wrong_environments", "Disturbed"))
    assert report.ok, str(report)
    assert "take states after the same rows in each run" in str(report)
