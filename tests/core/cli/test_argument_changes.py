"""Changes of single arguments of components: ``--OPTION.NAME VALUE``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset, NetworkConfig
from physx_core.cli import main
from physx_core.config import read_toml
from physx_core.errors import UnknownOptionError
from physx_core.pipelines import load_learner

SCRIPT = """
import json
from pathlib import Path
from physx_core import Transformation
from physx_core.toy import LeastSquares, Linear, Spring


def note(name, given):
    file = Path("given.json")
    noted = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps({**noted, name: given}))


class Env(Spring):
    def __init__(self, *, a=0, b=0, options=None, **kwargs):
        note("env_kwargs", {"a": a, "b": b, "options": options})
        super().__init__(**kwargs)


class Net(Linear):
    def __init__(self, *, a=0, b=0, options=None):
        note("network_kwargs", {"a": a, "b": b, "options": options})
        super().__init__()
        self.given = {"a": a, "b": b, "options": options}


class Opt(LeastSquares):
    def __init__(self, *, a=0, b=0, options=None):
        note("optimization_kwargs", {"a": a, "b": b, "options": options})

    def set_optimizer(self, optimizer, network, **kwargs):
        note("optimizer_kwargs", kwargs)
        super().set_optimizer(None, network)


class Trans(Transformation):
    def __init__(self, *, a=0, b=0, options=None):
        note("transformation_kwargs", {"a": a, "b": b, "options": options})
"""
KWARGS = ("network_kwargs", "optimization_kwargs", "optimizer_kwargs", "transformation_kwargs")
ALL = {"a": 1, "b": 2, "options": {"deep": {"x": 1, "y": 2}, "z": 3}}
TABLE = "{a = 1, b = 2, options = {deep = {x = 1, y = 2}, z = 3}}"


@pytest.fixture(autouse=True)
def job() -> None:
    """Write a script of components and a file that gives each of them all arguments."""
    Path("kept.py").write_text(SCRIPT)
    kwargs = "".join(f"{name} = {TABLE}\n" for name in KWARGS)
    Path("job.toml").write_text(
        "[data_generation]\nbatch_nb = 1\nbatch_size = 10\nsession_name = 'made'\n"
        "[data_generation.environment]\nenvironment = 'kept.py:Env'\n"
        f"as_tcp_ip_client = false\nenv_kwargs = {TABLE}\n"
        "[training]\nepoch_nb = 1\nbatch_size = 5\n[training.dataset]\n"
        "existing_dir = 'sessions/made'\n[training.network]\nnetwork = 'kept.py:Net'\n"
        f"optimization = 'kept.py:Opt'\ntransformation = 'kept.py:Trans'\n{kwargs}"
    )


@pytest.fixture
def trained() -> str:
    """Return a session whose components have all arguments."""
    for verb in ("generate", "train"):
        assert main([verb, "--config", "job.toml"]) == 0
    return "sessions/training"


def given(kind: str) -> dict[str, object]:
    found: dict[str, object] = json.loads(Path("given.json").read_text())[kind]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a", "64", {**ALL, "a": 64}),
        ("a", "[3, 32, 2]", {**ALL, "a": [3, 32, 2]}),
        ("a", "[x,y]", {**ALL, "a": ["x", "y"]}),
        ("b", "true", {**ALL, "b": True}),
        ("b", "-1.5", {**ALL, "b": -1.5}),
        ("b", "word", {**ALL, "b": "word"}),
        ("options.deep.x", "7", {**ALL, "options": {"deep": {"x": 7, "y": 2}, "z": 3}}),
        ("options.new", "{k=1}", {**ALL, "options": {**ALL["options"], "new": {"k": 1}}}),  # type: ignore[dict-item]
    ],
)
def test_one_argument_of_each_component_changes_and_the_others_stay(name, text, expected):
    words = ["--environment.env-kwargs." + name, text]
    assert main(["generate", "--config", "job.toml", *words]) == 0
    assert given("env_kwargs") == expected
    words = [w for kind in KWARGS for w in (f"--network.{kind.replace('_', '-')}.{name}", text)]
    assert main(["train", "--config", "job.toml", *words]) == 0
    network = read_toml("sessions/training/config.toml")["training"]["network"]
    for kind in KWARGS:
        assert given(kind) == network[kind] == expected


def test_several_changes_an_equals_sign_and_all_arguments_at_once():
    words = ["--environment.env-kwargs", "a=5", "--environment.env-kwargs.b=6"]
    words += ["--environment.env_kwargs.options.k", "8"]
    assert main(["generate", "--config", "job.toml", *words]) == 0
    assert given("env_kwargs") == {"a": 5, "b": 6, "options": {"k": 8}}


def test_predict_keeps_the_arguments_of_the_checkpoint(trained):
    words = ["predict", trained, "kept.py:Env", "--step-nb", "1", "--trust"]
    words += ["--network.network-kwargs.a", "64", "--network.transformation-kwargs.options.deep.x"]
    assert main([*words, "5", "--environment.env-kwargs.b", "9"]) == 0
    assert given("network_kwargs") == {**ALL, "a": 64}
    options = {"deep": {"x": 5, "y": 2}, "z": 3}
    assert given("transformation_kwargs") == {**ALL, "options": options}
    assert given("env_kwargs") == {"a": 0, "b": 9, "options": None}


def test_replay_keeps_the_arguments_of_the_dataset(trained):
    words = ["replay", "sessions/made", "kept.py:Env", "--environment.visualizer", "None"]
    assert main([*words, "--environment.env-kwargs.options.z", "64"]) == 0
    assert given("env_kwargs") == {**ALL, "options": {**ALL["options"], "z": 64}}


@pytest.mark.parametrize("network", [None, "kept.py:Net"])
def test_a_network_configuration_changes_arguments_of_the_checkpoint(trained, network):
    transformation = network and "kept.py:Trans"
    change = {"options": {"deep": {"y": 5}}}
    config = NetworkConfig(network, network_kwargs=change, transformation=transformation)
    learner = load_learner(trained, config, trust=network is None)
    expected = {**ALL, "options": {"deep": {"x": 1, "y": 5}, "z": 3}}
    assert learner.network.given == expected  # type: ignore[attr-defined]
    with pytest.raises(UnknownOptionError, match="steps"):
        load_learner(trained, NetworkConfig(network, {"steps": 1}), trust=True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env-kwargs.a"], "--environment.env-kwargs.a needs a value"),
        (["env-kwargs.a", "--quiet"], "--environment.env-kwargs.a needs a value"),
        (["env-kwargs.a", "3", "32"], 'takes one value, but "32" follows'),
        (["env-kwargs.", "3"], "names no argument"),
        (["env-kwargs.a.", "3"], "names no argument"),
        (["env-kwargs.a.x", "3"], "env-kwargs.a.x names an option in a, which is not a table"),
        (["env-kwargs.aa", "3"], 'Did you mean "a"'),
        (["env-kwarg.a", "3"], "env-kwarg.a"),
        (["num-clients.a", "3"], "num-clients.a"),
    ],
)
def test_mistakes_are_named(words, message, capsys):
    first, *others = words
    assert main(["generate", "--config", "job.toml", f"--environment.{first}", *others]) == 1
    text = capsys.readouterr()
    assert message in text.err + text.out and "Traceback" not in text.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "option"),
    [
        ("generate", "--environment.env-kwargs"),
        ("train", "--network.network-kwargs"),
        ("predict", "--network.network-kwargs"),
    ],
)
def test_help_and_completion_mention_single_arguments(verb, option, capsys):
    assert main([verb, "--help"]) == 0
    assert f"{option}.NAME VALUE" in capsys.readouterr().out
    assert main(["completion", "after", verb]) == 0
    assert f"{option}.NAME" in capsys.readouterr().out.split()
    assert main(["completion", "after", verb, f"{option}.a"]) == 0
    assert capsys.readouterr().out.split() == []
    assert main(["completion", "after", verb, f"{option}.a", "3"]) == 0
    assert f"{option}.NAME" in capsys.readouterr().out.split()


# Normalization: a switch, or a table ------------------------------------------------------------


TRAIN = [
    *("train", "--network.network", "toy/linear", "--dataset.existing-dir", "data"),
    *("--batch-size", "10", "--quiet"),
]


def store_samples():
    with Dataset.create("data") as dataset:
        widths = {"state": 2, "force": 1, "next_state": 2}
        random = np.random.default_rng(0)
        dataset.append("training", {n: random.random((20, w)) for n, w in widths.items()})


@pytest.mark.parametrize(
    ("file", "words", "expected"),
    [
        (None, [], False),
        (None, ["--dataset.normalize"], True),
        ("true", ["--dataset.normalize", "False"], False),
        ("true", ["--dataset.normalize.state", "field"], {"state": "field"}),
        (None, ["--dataset.normalize.state", "field"], {"state": "field"}),
        (
            '{state = "none"}',
            ["--dataset.normalize.next_state", "field"],
            {"state": "none", "next_state": "field"},
        ),
        ('{state = "none"}', ["--dataset.normalize", "next_state=field"], {"next_state": "field"}),
    ],
)  # fmt: skip
def test_normalization_is_switched_on_or_chosen_by_field(
    tmp_path, monkeypatch, file, words, expected
):
    monkeypatch.chdir(tmp_path)
    store_samples()
    if file is not None:
        Path("run.toml").write_text(f"[training.dataset]\nnormalize = {file}\n")
        words = ["--config", "run.toml", *words]
    assert main([*TRAIN, "--session-name", "run", "--epoch-nb", "1", *words]) == 0
    options = read_toml("sessions/run/config.toml")["training"]["dataset"]
    assert options["normalize"] == expected
    found = load_learner("sessions/run").transformation.normalization
    kinds = expected if isinstance(expected, dict) else {}
    for name in ("state", "next_state"):
        assert (name in found) == (expected is not False and kinds.get(name) != "none")
        if kinds.get(name) == "field":
            assert found[name].mean.shape == ()


@pytest.mark.slow
def test_a_method_or_field_that_does_not_exist_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    store_samples()
    for words, text in (
        (["--dataset.normalize.state", "chanel"], "state is 'chanel' but must be one of"),
        (["--dataset.normalize.stat", "field"], 'Did you mean "state"?'),
        (["--dataset.normalize.state", "channel"], "no axis named"),
    ):
        assert main([*TRAIN, "--epoch-nb", "1", *words]) != 0
        assert text in " ".join(capsys.readouterr().err.split())
