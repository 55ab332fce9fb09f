"""Files name components of installed plugins; any other code is the user's own word."""

import json
import os
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
    checkpoint,
    plugins,
)
from physx_core.checkpoint.description import END
from physx_core.cli import main
from physx_core.components import Network, Transformation
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    ReferenceFormError,
    UntrustedReferenceError,
)
from physx_core.pipelines import Replay, load_learner
from physx_core.toy import Linear

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
FIELDS = {"net_fields": ["state"], "opt_fields": ["next_state"]}

EVIL = """
import pathlib
from physx_core.toy import Linear, Spring
pathlib.Path(__file__).with_name("executed").touch()
class Net(Linear): pass
class Env(Spring): pass
def make(**kwargs): return Linear(**kwargs)
"""


class OwnTransformation(Transformation):
    """What `OwnNetwork` works with."""


class OwnNetwork(Linear):
    default_transformation = f"{__name__}:OwnTransformation"

    def __init__(self, *, bias=True, **fields):
        super().__init__(**fields)
        self.bias = bias


@pytest.fixture
def evil(tmp_path, monkeypatch):
    """A script that leaves a mark beside it when it is imported."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text(EVIL)
    return tmp_path / "evil.py"


@pytest.fixture
def executed(evil):
    return lambda: evil.with_name("executed").exists()


def session(network="toy/linear", **kwargs):
    """Train a network for an epoch in the session "training"."""
    config = NetworkConfig(network, {**FIELDS, **kwargs})
    Training(config, None, SPRING, epoch_nb=1, batch_nb=2, batch_size=4).execute()


def edit(text_of):
    """Let the description of the checkpoint be another one, with a valid checksum."""
    path = checkpoint.find(Path("sessions/training"), "network", -1).path
    file = path / checkpoint.DESCRIPTION
    body = text_of(file.read_text().rpartition("\n[checksum]")[0]).encode()
    file.write_bytes(body + END.format(zlib.crc32(body)).encode())


def name_in_dataset(folder, **info):
    """Let a dataset name another environment, with a valid checksum."""
    plain = json.loads((folder / "dataset.json").read_text())
    plain.pop("crc32")
    plain["info"] |= info
    body = json.dumps(plain, indent=1).encode()[:-2]
    (folder / "dataset.json").write_bytes(body + b',\n "crc32": "%08x"\n}' % zlib.crc32(body))


REFERENCES = ["{evil}:Net", "evil:Net", "os:system", "subprocess:Popen", "{evil}: Net"]


@pytest.mark.parametrize("reference", REFERENCES)
def test_a_checkpoint_imports_no_code(evil, executed, reference, capsys):
    session()
    reference = reference.format(evil=evil)
    edit(lambda text: text.replace('"toy/linear"', f'"{reference}"'))
    with pytest.raises(UntrustedReferenceError, match=r"--network\.network .*--trust"):
        load_learner("sessions/training")
    for words in (
        ["predict", "sessions/training", "toy/spring", "--step-nb", "1"],
        ["export-network", "sessions/training", "--to", "onnx"],
    ):
        assert main(words) == 1
        assert f'network = "{reference}"' in capsys.readouterr().err
    assert not executed()


@pytest.mark.parametrize("key", ["module", "activation", "deeper", "listed"])
def test_nor_in_the_arguments(evil, executed, key):
    session()
    values = {"deeper": f'{{a = [{{b = "{evil}:Net"}}]}}', "listed": '["x", "os:system"]'}
    line = f"{key} = {values.get(key, repr('evil:make'))}\n"
    edit(lambda text: text.replace("[network_kwargs]\n", f"[network_kwargs]\n{line}"))
    with pytest.raises(UntrustedReferenceError, match=rf"network_kwargs\.{key}"):
        load_learner("sessions/training")
    assert not executed()


def test_nor_as_transformation(evil, executed):
    session()
    edit(lambda text: text.replace('transformation = "', f'transformation = "{evil}:Net" # "'))
    for config in (NetworkConfig(), NetworkConfig("toy/linear"), NetworkConfig(Linear)):
        with pytest.raises(UntrustedReferenceError, match="transformation"):
            load_learner("sessions/training", config)
    assert not executed()


def test_trust_imports_classes_of_the_right_kind_only(evil, executed):
    session()
    name = {"now": "toy/linear"}

    def use(reference):
        edit(lambda text: text.replace(f'"{name["now"]}"', f'"{reference}"'))
        name["now"] = reference
        return load_learner("sessions/training", trust=True)

    for reference, message in {
        "os:system": "standard library",
        "subprocess:Popen": "standard library",
        f"{evil}:make": "not a class",
        f"{evil}:Env": "not derived from Network",
        f"{evil}:pathlib": "standard library|not a class",
    }.items():
        with pytest.raises((ReferenceFormError, UntrustedReferenceError), match=message):
            use(reference)
    assert type(use(f"{evil}:Net").network).__name__ == "Net"
    assert executed()
    assert main(["predict", "sessions/training", "toy/spring", "--step-nb", "1"]) == 1
    assert main(["predict", "sessions/training", "toy/spring", "--step-nb", "1", "--trust"]) == 0


def test_what_the_user_names_gets_the_arguments_of_the_checkpoint(evil):
    session(OwnNetwork, bias=False)
    with pytest.raises(UntrustedReferenceError, match="OwnNetwork"):
        load_learner("sessions/training")
    for config in (NetworkConfig(OwnNetwork), NetworkConfig(f"{__name__}:OwnNetwork")):
        learner = load_learner("sessions/training", config)
        assert learner.network.bias is False
        assert type(learner.transformation).__name__ == "OwnTransformation"
    Prediction(NetworkConfig(OwnNetwork), SPRING, step_nb=1).execute()
    own = NetworkConfig(OwnNetwork, {**FIELDS, "bias": True})
    assert load_learner("sessions/training", own).network.bias is True


def test_a_dataset_imports_no_code(evil, executed, capsys):
    session()
    folder = evil.parent / "sessions" / "training" / "dataset"
    for info in (
        {"environment": f"{evil}:Env"},
        {"environment": "evil:Env"},
        {"environment": "os:system", "env_kwargs": {"command": "touch executed"}},
        {"environment": "toy/spring", "env_kwargs": {"policy": ["evil:make"]}},
    ):
        name_in_dataset(folder, **info)
        with pytest.raises(UntrustedReferenceError, match=r"environment.*--trust"):
            Replay(DatasetConfig(existing_dir=str(folder)), session_name="seen").execute()
        assert main(["replay", str(folder), "--step-nb", "1"]) == 1
        assert "UntrustedReferenceError" in capsys.readouterr().err
    name_in_dataset(folder, environment="toy/spring", env_kwargs={}, num_clients=10**6)
    with pytest.raises(ConfigError, match="1000000 processes"):
        Replay(DatasetConfig(existing_dir=str(folder)), session_name="seen").execute()
    assert not executed()


def test_a_dataset_of_ones_own_environment_is_replayed(evil, executed):
    session()
    folder = evil.parent / "sessions" / "training" / "dataset"
    name_in_dataset(folder, environment="/elsewhere/evil.py:Env", env_kwargs={"stiffness": 3.0})
    drawn = ["--environment.visualizer", "None", "--step-nb", "1"]
    assert main(["replay", str(folder), *drawn]) == 1
    assert not executed()
    assert main(["replay", str(folder), f"{evil}:Env", *drawn]) == 0
    assert executed()
    name_in_dataset(folder, environment=f"{evil}:Env", env_kwargs={})
    assert main(["replay", str(folder), *drawn, "--trust"]) == 0


def test_a_function_of_the_user_may_make_a_network(evil):
    session(f"{evil}:make")
    learner = load_learner("sessions/training", NetworkConfig(f"{evil}:make"))
    assert isinstance(learner.network, Linear)


@pytest.mark.parametrize(
    ("kind", "reference"),
    [
        ("network", "os:system"),
        ("network", "subprocess:run"),
        ("network", "shutil:rmtree"),
        ("environment", "physx_core.toy:Linear"),
        ("environment", "physx_core.files:os.system"),
        ("backend", "physx_core.toy:Spring"),
        ("launcher", "numpy:pi"),
    ],
)
def test_types_are_checked_before_anything_is_called(kind, reference):
    with pytest.raises(ReferenceFormError):
        plugins.resolve(kind, reference)


def test_the_script_that_trained_predicts(tmp_path):
    """The class itself is the user's word."""
    (tmp_path / "own.py").write_text(
        "from physx_core import EnvironmentConfig, NetworkConfig, Prediction, Training\n"
        "from physx_core.toy import Linear\n"
        "class Net(Linear): pass\n"
        'if __name__ == "__main__":\n'
        '    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)\n'
        f"    network = NetworkConfig(Net, {FIELDS})\n"
        "    Training(network, None, spring, epoch_nb=1, batch_nb=2, batch_size=4).execute()\n"
        "    Prediction(network, spring, step_nb=1).execute()\n"
        "    Prediction(NetworkConfig(Net), spring, step_nb=1).execute()\n"
    )
    run = subprocess.run(
        [sys.executable, "own.py"], cwd=tmp_path, env=os.environ, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr


def test_notes_of_a_stranger_reach_no_method(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", {"x": np.ones((2, 1))})
        dataset.update_info(**{"self": 5, "mode": "x"})
        assert dataset.info["self"] == 5


class Numbers(Network):
    """Has the parameters and files that a network in NumPy has by default."""

    def __init__(self):
        self.weights = np.zeros((2, 3))

    def get_parameters(self):
        return {"weights": self.weights}

    def predict(self, data):
        return data


@pytest.mark.parametrize("kind", ["bomb", "claim", "pickle", "one array", "text", "cut"])
def test_parameters_in_numpy_may_come_from_a_stranger(tmp_path, kind):
    network, path = Numbers(), tmp_path / "a.npz"
    network.save_parameters(path)
    network.load_parameters(path)
    if kind == "bomb":
        np.savez_compressed(path, weights=np.zeros((2000, 1000)))
    elif kind == "claim":
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (2, %d), }" % 2**50
        content = b"\x93NUMPY\x01\x00\x80\x00" + header.ljust(127) + b"\n"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("weights.npy", content)
    elif kind == "pickle":
        np.savez(path, weights=np.array([{}], object))
    elif kind == "one array":
        with path.open("wb") as file:
            np.save(file, network.weights)
    else:
        content = b"text" if kind == "text" else path.read_bytes()[:-30]
        path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"a\.npz does not contain parameters"):
        network.load_parameters(path)
