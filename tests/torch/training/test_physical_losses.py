"""Losses in physical units, and networks and losses that differentiate predictions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import (
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Prediction,
    Training,
    View,
    read_scalars,
)
from physx_core.cli import main
from physx_core.components import PredictedBatch
from physx_core.errors import ConfigError
from physx_core.pipelines import Learner, load_learner
from physx_core.toy import LeastSquares
from physx_torch import FC, TorchOptimization

COMMON = {"loss": "MSELoss", "optimizer": "Adam", "device": "cpu", "data_type": "float64"}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def train(network, fields, *, normalize=True, optimization=TorchOptimization, **options):
    config = NetworkConfig(network, fields, optimization=optimization, **COMMON)
    data = DatasetConfig(existing_dir="data", normalize=normalize)
    options = {"epoch_nb": 2, "batch_size": 16, "seed": 0, "quiet": True, **options}
    training = Training(config, data, session_name="run", **options)
    training.execute()
    return training


def store(make, rows=64):
    """Store rows of each mode, which `make` returns for a generator of random numbers."""
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        for mode in ("training", "validation"):
            dataset.append(mode, make(rng, rows))


def motion(rng, rows):
    time = rng.uniform(20, 24, (rows, 1))
    return {"time": time, "x": 300 + 5 * np.sin(np.pi * time)}


# Physical units ---------------------------------------------------------------------------------


class Wave(torch.nn.Module):
    """A tanh, whose derivatives are known."""

    def __init__(self):
        super().__init__()
        self.height = torch.nn.Parameter(torch.tensor(0.7))
        self.rate = torch.nn.Parameter(torch.tensor(1.3))

    def forward(self, time):
        return self.height * torch.tanh(self.rate * time)


class Oscillator(TorchOptimization):
    """Adds the residual of x'' + 9 x = 0, x in m, and compares it with the exact one."""

    modes: set

    def compute_loss(self, batch):
        time = batch.data["time"].detach().requires_grad_()
        x = batch.predict({**batch.data, "time": time})["x"]
        (speed,) = torch.autograd.grad(x.sum(), time, create_graph=True)
        (acceleration,) = torch.autograd.grad(speed.sum(), time, create_graph=True)
        residual = acceleration + 9 * x
        torch.testing.assert_close(x, batch.physical_prediction["x"])
        np.testing.assert_allclose(residual.detach(), self.exact(batch), rtol=1e-9)
        self.modes.add(batch.network.training)
        return super().compute_loss(batch) + 1e-3 * residual.square().mean()

    def exact(self, batch):
        """Return x'' + 9 x of a `Wave`, derived by hand."""
        known = batch.transformation.normalization
        (t0, dt), (x0, dx) = (
            (known[name].mean, known[name].std) if known else (0.0, 1.0) for name in ("time", "x")
        )
        a, b = (getattr(batch.network.module, name).item() for name in ("height", "rate"))
        bend = np.tanh(b * (batch.data["time"].numpy() - t0) / dt)
        acceleration = -2 * dx * a * (b / dt) ** 2 * bend * (1 - bend**2)
        return acceleration + 9 * (x0 + dx * a * bend)


@pytest.mark.parametrize("normalize", [False, True])
def test_the_residual_of_an_equation_is_the_exact_one_in_physical_units(normalize):
    store(motion)
    Oscillator.modes = set()
    fields = {"net_fields": "time", "opt_fields": "x"}
    training = train(Wave, fields, normalize=normalize, optimization=Oscillator)
    assert Oscillator.modes == {True, False}  # it was trained and validated
    assert np.isfinite([training.training_loss, training.validation_loss]).all()


class Looking(TorchOptimization):
    """Keeps the last batch, and records an error in percent of the physical values."""

    extra_fields = ("other",)
    batch: PredictedBatch

    def transform_loss(self, loss, batch):
        type(self).batch = batch
        guess, truth = batch.physical_prediction["y"], batch.physical_targets["y"]
        percent = 100 * torch.linalg.norm(guess - truth) / torch.linalg.norm(truth)
        return {**super().transform_loss(loss, batch), "percent": percent.detach()}


UNET = {
    "nb_dims": 2, "nb_input_channels": 1, "nb_output_channels": 1, "nb_first_layer_channels": 2,
    "nb_steps": 1, "data_scale": 3.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("network", "arguments", "shape"), [("torch/fc", {}, (3,)), ("torch/unet", UNET, (5, 7, 1))]
)
def test_a_batch_has_both_normalized_and_physical_values(network, arguments, shape):
    def make(rng, rows):
        x = rng.normal(50, 2, (rows, *shape))
        return {"x": x, "y": 1e3 * x, "other": rng.random(rows)}

    store(make)
    if network == "torch/fc":
        arguments = {"layers": [3, 4, 3]}
    fields = {**arguments, "net_fields": "x", "opt_fields": "y"}
    training = train(network, fields, optimization=Looking)
    batch = Looking.batch
    scale, known = arguments.get("data_scale", 1.0), batch.transformation.normalization["y"]
    assert set(batch.data) == {"x", "y", "other"} and len(batch.data["other"]) == 16
    assert 45e3 < batch.physical_targets["y"].mean() < 55e3
    assert abs(batch.targets["y"].mean()) < scale and abs(batch.inputs["x"].mean()) < 1
    for physical, compared in (
        (batch.physical_targets, batch.targets),
        (batch.physical_prediction, batch.prediction),
    ):
        values = compared["y"].detach().numpy() / scale * known.std + known.mean
        np.testing.assert_allclose(physical["y"].detach(), values, rtol=1e-9)
    batch.network.set_eval()
    whole = batch.predict(batch.data)["y"]
    torch.testing.assert_close(batch[3:5].physical_targets["y"], batch.data["y"][3:5])
    torch.testing.assert_close(batch.predict(batch[3:5].data)["y"], whole[3:5])
    recorded = read_scalars(training.session.path)["epoch", "percent/validation"]
    assert list(recorded) == [1, 2] and 0 < recorded[2] < 100


def test_losses_of_rows_may_differentiate():
    network = Learner(
        NetworkConfig(Wave, {"net_fields": "time", "opt_fields": "x"}, device="cpu"), trains=False
    )
    network.network.set_data_type("float64")
    network.network.set_train()
    optimization = Oscillator()
    Oscillator.modes = set()
    optimization.set_loss("MSELoss")
    optimization.set_optimizer("SGD", network.network, lr=0.1)
    rows = {name: torch.tensor(v) for name, v in motion(np.random.default_rng(0), 3).items()}
    batch = PredictedBatch.of(network.network, network.transformation, rows)
    losses = optimization.compute_row_losses(batch)
    assert losses.shape == (3,) and not losses.requires_grad
    assert losses.mean().item() == pytest.approx(optimization.compute_loss(batch).item())


# Networks that differentiate --------------------------------------------------------------------


class Potential(torch.nn.Module):
    """The stress of a learned energy: its derivative with respect to the strain."""

    def __init__(self):
        super().__init__()
        layers = torch.nn.Linear(3, 16), torch.nn.Softplus(), torch.nn.Linear(16, 1)
        self.energy = torch.nn.Sequential(*layers)
        self.recorded = []

    def forward(self, strain):
        self.recorded.append(torch.is_grad_enabled())
        strain = strain.detach().requires_grad_()
        return torch.autograd.grad(self.energy(strain).sum(), strain, create_graph=True)[0]


class Hamiltonian(torch.nn.Module):
    """The motion of a learned energy, whose inputs are differentiated in place."""

    def __init__(self):
        super().__init__()
        layers = torch.nn.Linear(6, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)
        self.energy = torch.nn.Sequential(*layers)

    def forward(self, q, p):
        q.requires_grad_()
        p.requires_grad_()
        energy = self.energy(torch.cat([q, p], dim=1)).sum()
        dq, dp = torch.autograd.grad(energy, (q, p), create_graph=self.training)
        return dp, -dq


def elastic(rng, rows):
    strain = rng.normal(size=(rows, 3))
    return {"strain": strain, "stress": 2 * strain + (strain**2).sum(1, keepdims=True) * strain}


def oscillating(rng, rows):
    q, p = rng.normal(size=(2, rows, 3))
    return {"q": q, "p": p, "speed": p, "force": -q}


DERIVED = {
    "potential": (Potential, elastic, {"net_fields": "strain", "opt_fields": "stress"}),
    "Hamiltonian": (
        Hamiltonian,
        oscillating,
        {"net_fields": ["q", "p"], "opt_fields": ["speed", "force"]},
    ),
}


@pytest.mark.parametrize("kind", DERIVED)
@pytest.mark.parametrize("normalize", [False, True])
def test_a_network_may_differentiate_its_own_output(kind, normalize):
    module, make, fields = DERIVED[kind]
    store(make)
    training = train(module, fields, normalize=normalize, epoch_nb=4)
    assert training.validation_loss == training.validation_loss
    found = load_learner("sessions/run", NetworkConfig(module))
    rows = make(np.random.default_rng(5), 7)
    with torch.no_grad():
        expected = found.predict(rows)
    again = training.learner.predict_in_training(rows)
    for name, values in found.predict(rows).items():
        assert values.shape == (7, 3)
        np.testing.assert_allclose(values, expected[name], rtol=1e-13)  # a GPU rounds by batch
        np.testing.assert_allclose(values, again[name], rtol=1e-13)
    tensors = found.network.predict(found.network.numpy_to_tensor(rows))
    assert not any(tensor.requires_grad for tensor in tensors.values())


class Bar(Environment):
    """Asks for the stress of its strain."""

    def create(self):
        self.strain = self.rng.normal(size=3)

    def init_database(self):
        self.define_training_fields([Field("strain", (3,)), Field("stress", (3,))])

    def step(self):
        stress = self.get_prediction(strain=self.strain)["stress"]
        self.strain = 0.9 * self.strain
        self.set_training_data(strain=self.strain, stress=stress)


def test_an_environment_asks_a_network_that_differentiates():
    store(elastic)
    train(*(DERIVED["potential"][i] for i in (0, 2)), normalize=True)
    environment = EnvironmentConfig(Bar, as_tcp_ip_client=False)
    config = NetworkConfig(Potential, device="cpu")
    prediction = Prediction(config, environment, session_name="run", step_nb=3, quiet=True)
    prediction.execute()
    assert np.isfinite(prediction.prediction["stress"]).all()


def test_gradients_are_recorded_only_where_a_network_needs_them():
    network = Learner(
        NetworkConfig(Potential, DERIVED["potential"][2], device="cpu"), trains=False
    ).network
    network.set_eval()
    strain = {"strain": torch.ones(2, 3)}
    for _ in range(3):
        network.predict(strain)
    assert network.module.recorded == [False, True, True, True]  # found out once

    class Plain(FC):
        calls = 0

        def forward(self, x):
            assert not torch.is_grad_enabled()
            self.calls += 1
            return super().forward(x)

    plain = Plain([3, 1], net_fields="x", opt_fields="y")
    plain.set_eval()
    for _ in range(3):
        plain.predict({"x": torch.ones(2, 3)})
    assert plain.calls == 3


def test_other_errors_of_a_network_are_raised_at_once():
    class Failing(FC):
        calls = 0

        def forward(self, x):
            self.calls += 1
            raise RuntimeError("shapes cannot be multiplied")

    network = Failing([3, 1])
    network.set_eval()
    with pytest.raises(RuntimeError, match="cannot be multiplied"):
        network.predict({"input": torch.ones(2, 3)})
    assert network.calls == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("form", "kind"), [("onnx", "potential"), ("pt2", "potential"), ("pt2", "Hamiltonian")]
)
def test_a_network_that_differentiates_is_exported(kind, form, tmp_path):
    module, make, fields = DERIVED[kind]
    store(make)
    train(module, fields)
    learner = load_learner("sessions/run", NetworkConfig(module, device="cpu"))
    path = tmp_path / f"network.{form}"
    if form == "onnx":
        pytest.importorskip("onnxscript")
    learner.export(path, form)
    for count in (5, 3, 1):  # 3 is the size of another axis, too
        rows = make(np.random.default_rng(1), count)
        rows = {name: rows[name] for name in learner.network.net_fields}
        expected = learner.predict(rows)
        if form == "pt2":
            tensors = {name: torch.from_numpy(values) for name, values in rows.items()}
            found = {n: v.numpy() for n, v in torch.export.load(path).module()(tensors).items()}
        else:
            session = pytest.importorskip("onnxruntime").InferenceSession(path)
            names = [item.name for item in session.get_outputs()]
            found = dict(zip(names, session.run(names, rows), strict=True))
        for name, values in expected.items():
            np.testing.assert_allclose(found[name], values, atol=1e-5)


def test_torchscript_has_no_derivatives(tmp_path):
    learner = Learner(NetworkConfig(Potential, DERIVED["potential"][2], device="cpu"), trains=False)
    learner.bind({name: Field(name, (3,)) for name in ("strain", "stress")}, {})
    with pytest.raises(ConfigError, match="TorchScript does not record derivatives; onnx and pt2"):
        learner.export(tmp_path / "network.pt", "torchscript")


# Numbers of predictions and targets --------------------------------------------------------------


class Parts(torch.nn.Module):
    """Splits a displacement into an elastic and a plastic part."""

    def __init__(self):
        super().__init__()
        self.first, self.second = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)

    def forward(self, force):
        return self.first(force), self.second(force)


class SumOfParts(TorchOptimization):
    """Compares the sum of the predictions with the only target."""

    def compute_loss(self, batch):
        return self.loss(sum(batch.prediction.values()), batch.targets["displacement"])


PARTS = {"net_fields": "force", "opt_fields": "displacement", "pred_fields": ["elastic", "plastic"]}


def bending(rng, rows):
    force = rng.normal(size=(rows, 2))
    return {"force": force, "displacement": 3 * force}


def test_one_loss_of_several_predictions_and_one_target():
    store(bending)
    training = train(Parts, PARTS, optimization=SumOfParts, epoch_nb=5)
    assert training.validation_loss < 5
    answer = load_learner("sessions/run", NetworkConfig(Parts)).predict({"force": np.ones((4, 2))})
    assert set(answer) == {"elastic", "plastic"}


def test_predictions_without_targets_need_a_loss_for_them(tmp_path):
    store(bending)
    with pytest.raises(ConfigError, match=r"elastic, plastic but is compared with displacement"):
        train(Parts, PARTS)
    assert not (tmp_path / "sessions").exists()
    optimization = TorchOptimization()
    with pytest.raises(ConfigError, match=r"compute_loss\(batch\)"):
        optimization.set_optimizer(
            "Adam", Learner(NetworkConfig(Parts, PARTS), trains=False).network
        )


# Differential equations --------------------------------------------------------------------------


class Field2D(torch.nn.Module):
    """A product of tanh, whose derivatives are known."""

    def __init__(self):
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor([0.7, -0.4]))

    def forward(self, x):
        return torch.tanh(x @ self.rate)[:, None]


def heat(batch):
    """Return the mean squared residual of u_t = 3 u_xx, of u in K, x in m and t in s."""
    x, u = batch.data["x"], batch.physical_prediction["u"]
    (slope,) = torch.autograd.grad(u.sum(), x, create_graph=True)
    (bend,) = torch.autograd.grad(slope[:, 0].sum(), x, create_graph=True)
    residual = slope[:, 1] - 3 * bend[:, 0]
    np.testing.assert_allclose(residual.detach(), heat_exactly(batch), rtol=1e-9, atol=1e-12)
    heat.modes.add(batch.network.training)
    return residual.square().mean()


def heat_exactly(batch):
    """Return the residual of a `Field2D`, derived by hand."""
    known = batch.transformation.normalization
    x0, dx, du = 0.0, np.ones(2), 1.0
    if known:
        x0, dx, du = known["x"].mean, known["x"].std, known["u"].std
    rate = batch.network.module.rate.detach().numpy() / dx
    bent = np.tanh((batch.data["x"].detach().numpy() - x0) @ rate)
    first = 1 - bent**2
    return du * (first * rate[1] + 3 * 2 * bent * first * rate[0] ** 2)


def warm(rng, rows):
    x = rng.uniform(10, 14, (rows, 2))
    return {"x": x, "u": 300 + x[:, :1] * x[:, 1:]}


@pytest.mark.parametrize("normalize", [False, True])
def test_the_residual_of_a_differential_equation_is_a_term_of_the_loss(normalize):
    store(warm)
    heat.modes = set()
    config = NetworkConfig(
        Field2D, {"net_fields": "x", "opt_fields": "u"}, optimizer="Adam", device="cpu",
        data_type="float64", loss={"u": "MSELoss", "heat": heat},
        optimization_kwargs={"differentiates_inputs": True, "loss_weights": {"heat": 0.1}},
    )  # fmt: skip
    data = DatasetConfig(existing_dir="data", normalize=normalize)
    training = Training(config, data, epoch_nb=2, batch_size=16, quiet=True, session_name="run")
    training.execute()
    assert heat.modes == {True, False}  # it was trained and validated
    curves = read_scalars(training.session.path)
    assert curves["epoch", "loss/heat/validation"][2] > 0
    learner = training.learner
    rows = learner.network.numpy_to_tensor(warm(np.random.default_rng(1), 3))
    learner.network.set_train()
    batch = PredictedBatch.of(
        learner.network, learner.transformation, learner.network.with_gradients(rows)
    )
    losses = learner.optimization.compute_row_losses(batch)
    assert losses.mean().item() == pytest.approx(learner.optimization.compute_loss(batch).item())


def test_inputs_that_cannot_be_differentiated_are_refused():
    store(warm)

    class Differentiating(LeastSquares):
        differentiates_inputs = True

    network = NetworkConfig(
        "toy/linear", {"net_fields": "x", "opt_fields": "u"}, optimization=Differentiating
    )
    with pytest.raises(ConfigError, match="leave out differentiates_inputs"):
        Training(network, "data", epoch_nb=1, batch_size=8, quiet=True).execute()
    network = NetworkConfig(
        Field2D, {"net_fields": "x", "opt_fields": "u"}, loss="MSELoss", optimizer="Adam",
        optimization_kwargs={"differentiates_inputs": True},
    )  # fmt: skip
    view = View(window={"x": ("u", 0), "u": ("u", 1)})
    rows = {"u": np.ones((10, 2)), "episode": np.zeros(10, int), "step": np.arange(10)}
    with Dataset.create("steps") as dataset:
        dataset.append("training", rows)
    data = DatasetConfig(existing_dir="steps", view=view)
    with pytest.raises(ConfigError, match=r"leave out Training\.unroll and noise"):
        Training(network, data, epoch_nb=1, batch_size=8, quiet=True, unroll=[2]).execute()


# From the command line ---------------------------------------------------------------------------

LOSSES = '''
"""Losses of a batch."""

def momentum(batch):
    """Return the mean squared residual of dv = 0.1 F, with a force in N and a mass of 1 kg."""
    before, after = batch.data["v"], batch.physical_prediction["next_v"]
    return (after - before - 0.1 * batch.data["force"]).square().mean()
'''


def falling(rng, rows):
    v, force, x = rng.normal(size=(3, rows, 1))
    return {"v": v, "force": force, "x": x, "next_v": v + 0.1 * force, "next_x": x + 0.1 * v}


@pytest.mark.slow
def test_losses_by_target_and_of_the_batch_are_named_in_a_command(tmp_path, capsys):
    store(falling)
    (tmp_path / "losses.py").write_text(LOSSES)
    words = [
        *("train", "--dataset.existing-dir", "data", "--session-name", "run"),
        *("--epoch-nb", "3", "--batch-size", "16"),
        *("--network.network", "torch/fc", "--network.network-kwargs", "layers=[2,8,2]"),
        *("net_fields=[v,x]", "opt_fields=[next_v,next_x]", "--network.optimizer", "Adam"),
        *("--network.loss", "next_v=MSELoss", "next_x=L1Loss", "law=losses.py:momentum"),
        *("--network.optimization-kwargs", "extra_fields=[force]", "loss_weights={law=0.5}"),
        *("--network.device", "cpu", "--dataset.normalize", "--seed", "0", "--quiet"),
    ]
    assert main(words) == 0
    curves = read_scalars(tmp_path / "sessions/run")
    parts = [curves["epoch", f"loss/{name}/training"] for name in ("next_v", "next_x", "law")]
    first, second, law = (np.array(list(part.values())) for part in parts)
    total = np.array(list(curves["epoch", "loss/training"].values()))
    np.testing.assert_allclose(total, (first + second + 0.5 * law) / 2.5, rtol=1e-6)
    assert ("epoch", "loss/law/validation") in curves
    again = ["train", "sessions/run", "--resume", "--quiet", "--epoch-nb", "4"]
    (tmp_path / "losses.py").rename(tmp_path / "laws.py")
    assert main([*again, "--network.loss.law", "laws.py:momentum"]) == 0
    assert main([*again, "--network.loss.next_x", "MSELoss"]) != 0
    assert "network.loss was" in capsys.readouterr().err
