"""Exported networks give what the network gives, in physical units."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Normalization, Training
from physx_core.cli import main
from physx_core.errors import CheckpointError, ConfigError, MissingLibraryError
from physx_core.pipelines import Learner

pytestmark = pytest.mark.processes

FORMS = ("onnx", "torchscript", "pt2")
NETWORKS = {
    "several fields": (
        "torch/fc",
        {"layers": [14, 8, 7], "net_fields": ["a", "b", "on"], "opt_fields": ["c", "b"]},
        [Field("a", (4, 3)), Field("b", ()), Field("on", (), "bool"), Field("c", (2, 3))],
    ),
    "unet": (
        "torch/unet",
        {
            "nb_dims": 2,
            "nb_input_channels": 2,
            "nb_output_channels": 1,
            "nb_first_layer_channels": 2,
            "nb_steps": 1,
            "data_scale": 3.0,
            "normalization": "batch",
            "positions": True,
        },
        [Field("input", (5, 4, 2)), Field("ground_truth", (20, 1))],
    ),
    "a plain module": (
        "torch.nn:Linear",
        {"in_features": 3, "out_features": 2, "net_fields": "x", "opt_fields": "y"},
        [Field("x", (3,)), Field("y", (2,))],
    ),
}


def learner_of(name):
    reference, arguments, fields = NETWORKS[name]
    learner = Learner(NetworkConfig(reference, arguments, device="cpu"), trains=False)
    rng = np.random.default_rng(0)
    normalization = {
        field.name: Normalization(rng.random(field.shape), 0.5 + rng.random(field.shape))
        for field in fields
        if np.dtype(field.dtype).kind == "f"
    }
    learner.bind({field.name: field for field in fields}, normalization)
    learner.network.set_eval()
    return learner


def samples_for(learner, count):
    rng = np.random.default_rng(1)
    fields = [learner.fields[name] for name in learner.network.net_fields]
    return {
        f.name: (rng.random((count, *f.shape)) > 0.5)
        if np.dtype(f.dtype).kind == "b"
        else rng.random((count, *f.shape), np.float32)
        for f in fields
    }


def run_file(path, form, data):
    """Return what a file makes of arrays by field, in the program that it is made for."""
    if form == "onnx":
        runtime = pytest.importorskip("onnxruntime")
        session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
        assert [item.name for item in session.get_inputs()] == list(data)
        names = [item.name for item in session.get_outputs()]
        return dict(zip(names, session.run(names, data), strict=True))
    tensors = {name: torch.from_numpy(values) for name, values in data.items()}
    module = torch.jit.load(path) if form == "torchscript" else torch.export.load(path).module()
    return {name: values.numpy() for name, values in module(tensors).items()}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("form", FORMS)
def test_files_give_what_the_network_gives(form, name, tmp_path):
    if form == "onnx":
        pytest.importorskip("onnxscript")
    learner = learner_of(name)
    path = tmp_path / f"network.{form}"
    learner.network.set_train()
    learner.export(path, form)
    assert learner.network.training and all(p.requires_grad for p in learner.network.parameters())
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    learner.network.set_eval()
    for count in (5, 1):
        data = samples_for(learner, count)
        expected = learner.predict(data)
        found = run_file(path, form, data)
        if name == "several fields":
            assert list(found) == ["c", "predicted_b"]  # b is read as well
            found["b"] = found.pop("predicted_b")
        assert list(found) == list(expected)
        for field, values in expected.items():
            assert found[field].shape == values.shape
            np.testing.assert_allclose(found[field], values, atol=1e-5)


@pytest.fixture
def session(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    x = 100 + 10 * rng.random((40, 3))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x, "y": x[:, :2] ** 2})
    network = NetworkConfig(
        "torch/fc",
        {"layers": [3, 8, 2], "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="Adam",
    )
    data = DatasetConfig(existing_dir="data", normalize=True)
    training = Training(network, data, epoch_nb=1, batch_size=10, seed=0)
    training.execute()
    expected = training.learner.predict_in_training({"x": x})["y"]
    return x.astype(np.float32), expected


def test_a_sessions_network_by_the_command(session, tmp_path, capsys):
    pytest.importorskip("onnxscript")
    x, expected = session
    assert main(["export-network", "sessions/training", "--to", "onnx"]) == 0
    assert "x -> y" in capsys.readouterr().out
    path = tmp_path / "sessions/training/network_0.onnx"
    found = run_file(path, "onnx", {"x": x})["y"]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_file_is_used_without_physx(session, tmp_path):
    x, expected = session
    words = ["export-network", "sessions/training/network/network_0", "--to", "torchscript"]
    assert main([*words, "--output", "spring.pt"]) == 0
    np.save("x.npy", x)
    code = (
        "import sys, torch, numpy as np\n"
        "network = torch.jit.load('spring.pt')\n"
        "y = network({'x': torch.from_numpy(np.load('x.npy'))})['y']\n"
        "assert not y.requires_grad\n"
        "np.save('y.npy', y.numpy())\n"
        "assert not any(name.startswith('physx') for name in sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    np.testing.assert_allclose(np.load("y.npy"), expected, rtol=1e-5)


def test_what_cannot_be_exported(session, tmp_path, capsys, monkeypatch):
    learner = learner_of("a plain module")
    with pytest.raises(ConfigError, match='"tflite".*Forms: onnx, pt2, torchscript'):
        learner.export(tmp_path / "file", "tflite")
    with pytest.raises(ConfigError, match='cannot be exported as "torchscript": FileNotFound'):
        learner.export(tmp_path / "nowhere" / "file", "torchscript")
    assert main(["export-network", "data", "--to", "onnx"]) == 1
    assert CheckpointError.__name__ in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(MissingLibraryError, match=r'pip install .*physx.torch\[export\]"'):
        learner.export(tmp_path / "file", "onnx")


def test_networks_of_other_libraries_say_that_they_have_no_forms(tmp_path):
    learner = Learner(NetworkConfig("toy/linear"), trains=False)
    with pytest.raises(ConfigError, match='Linear cannot be exported as "onnx"'):
        learner.export(tmp_path / "file", "onnx")
