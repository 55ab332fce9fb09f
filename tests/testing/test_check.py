"""``physx check`` prints a table or JSON, and its exit status says whether a contract is kept."""

import json
from pathlib import Path

import pytest

from physx_core.cli import main

pytestmark = pytest.mark.processes

PROGRAMS = Path(__file__).with_name("programs")


@pytest.mark.slow
def test_a_plugin_that_keeps_its_contracts(capsys):
    assert main(["check", "toy"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].split() == ["kind", "component", "passed", "failed", "expected", "skipped"]
    rows = {tuple(line.split()[:2]): line.split()[2:] for line in lines[1:]}
    assert rows.keys() == {
        ("environment", "toy/spring"),
        ("network", "toy/linear"),
        ("optimization", "toy/least-squares"),
        ("transformation", "toy/identity"),
    }
    assert all(int(row[0]) >= 7 and row[1:] == ["0", "0", "0"] for row in rows.values())


def test_a_component_that_does_not(capsys):
    component = f"{PROGRAMS}/wrong_choosers.py:Unseeded"
    assert main(["check", component]) == 1
    done = capsys.readouterr()
    assert "chooses the same again:\n    a second run with the same seed" in done.out
    assert f"ContractError: 1 of 1 not as expected: sampler {component}" in done.err
    known = [
        *("--expect", "chooses the same again=known", "chooses the same in any order=known"),
        "begins again=known",
    ]
    assert main(["check", component, *known]) == 0
    assert "expected: sampler" in capsys.readouterr().out


def test_json(capsys):
    component = f"{PROGRAMS}/wrong_choosers.py:Decreases"
    assert main(["check", component, "--json", "--kwargs", "capacity=48"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["ok"]
    (report,) = found["reports"]
    assert (report["kind"], report["component"], report["ok"]) == ("buffer", component, False)
    assert report["counts"]["failed"] == sum(c["status"] == "failed" for c in report["checks"]) > 0


@pytest.mark.faults
def test_options_of_a_network(capsys):
    pytest.importorskip("physx_torch")
    words = ["torch/fc", "--kwargs", "layers=[6,5,4]", "--fields", "input=[2,3]"]
    assert main(["check", *words, "ground_truth=4"]) == 0
    learner = ["--network", "torch/fc", "--network-kwargs", "layers=[4,8,3]", "--loss", "MSELoss"]
    words = ["torch/default", "--kind", "optimization", *learner, "--optimizer", "SGD"]
    assert main(["check", *words, "--lr", "0.05"]) == 0
    assert "optimization torch/default 9" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nothing"], 'No plugin "nothing" is installed'),
        (["toy/nothing"], "nothing"),
        (["toy", "--kind", "engine"], "not a kind of component"),
        (["toy", "--kwargs", "mass=2"], "name one of them"),
        (["toy/spring", "--expect", "flies=no"], "There are no checks ['flies']"),
        (["toy/spring", "--loss", "MSELoss"], "need --network"),
        (["toy/linear", "--fields", "state=big"], "is not a shape"),
        (["physx_core.fields:Field"], "specify its kind"),
    ],
)
def test_mistakes_are_errors(words, text, capsys):
    assert main(["check", *words]) == 1
    done = capsys.readouterr()
    assert text in done.err
    assert "passed" not in done.out or done.out.count("\n") == 1


def test_what_cannot_be_checked_is_no_success(capsys):
    assert main(["check", "physx/table"]) == 1
    assert "it needs options: file" in capsys.readouterr().out
