"""UNet: shapes and places for all its forms, and that it learns."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Normalization, Training
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch import FC, UNet, UNetTransformation

FORMS = [
    pytest.param(dims, mode, steps, two, id=f"{dims}D {mode} {steps} steps {1 + two} sublayers")
    for dims, mode, steps, two in itertools.product(
        (2, 3), ("same", "valid"), (1, 2, 3), (False, True)
    )
    if (dims, mode, steps) != (3, "valid", 3)
]
FORMS.append(pytest.param(3, "valid", 3, False, id="3D valid 3 steps 1 sublayers"))


def field_of(name, *shape):
    return Field(name, shape)


def made(size, inputs=1, outputs=1, fields=None, normalization=None, **options):
    options = {"nb_first_layer_channels": 1, "nb_steps": 2, **options}
    network = UNet(len(size), nb_input_channels=inputs, nb_output_channels=outputs, **options)
    network.bind(
        fields
        or {
            "input": field_of("input", *size, inputs),
            "ground_truth": field_of("ground_truth", *size, outputs),
        }
    )
    transformation = UNetTransformation()
    transformation.set_normalization(normalization or {}, network)
    network.set_eval()
    return network, transformation


def predicted(network, transformation, data):
    output = network.predict(transformation.transform_before_prediction(data))
    return transformation.transform_before_apply(output)


def pass_through(network):
    """Let the finest level hand on what it reads, and all others nothing."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        for level in (network.down[0], network.join[-1]):
            for module in level:
                if isinstance(module, (torch.nn.Conv2d, torch.nn.Conv3d)):
                    module.weight[(0, 0, *[1] * len(network.size))] = 1
                elif not isinstance(module, torch.nn.ReLU):
                    module.weight.fill_(1)
        network.last.weight.fill_(1)


# Shapes and places ------------------------------------------------------------------------------


@pytest.mark.parametrize(("dims", "mode", "steps", "two"), FORMS)
@pytest.mark.parametrize("skip_merge", [False, True])
def test_every_size_comes_back(dims, mode, steps, two, skip_merge):
    options = {"border_mode": mode, "nb_steps": steps, "two_sublayers": two}
    for size in [(10, 10, 10), (1, 5, 8), (7, 16, 3)]:
        size = size[:dims]
        network, transformation = made(size, 2, 3, skip_merge=skip_merge, **options)
        x = torch.rand(1, *size, 2)
        padded = transformation.transform_before_prediction({"input": x})["input"]
        assert all(long % 2**steps == 0 for long in padded.shape[1:-1]) or mode == "valid"
        torch.testing.assert_close(padded.norm(), x.norm())  # what is added is zero
        raw = network.predict({"input": padded})["prediction"]
        if mode == "same":
            assert raw.shape[:-1] == padded.shape[:-1]
        prediction = transformation.transform_before_apply({"prediction": raw})["prediction"]
        assert prediction.shape == (1, *size, 3)


@pytest.mark.parametrize(("dims", "mode", "steps", "two"), FORMS)
def test_every_value_comes_back_to_its_place(dims, mode, steps, two):
    options = {"border_mode": mode, "nb_steps": steps, "two_sublayers": two}
    size = (5, 6, 4)[:dims]
    network, transformation = made(size, **options)
    pass_through(network)
    x = torch.rand(2, *size, 1)
    prediction = predicted(network, transformation, {"input": x})["prediction"]
    torch.testing.assert_close(prediction, x, atol=1e-4, rtol=1e-4)  # epsilon of normalization


def test_padding_is_the_least():
    same, _ = made((10, 16, 1), nb_steps=3, border_mode="same")
    assert [axis.padded for axis in same.borders] == [16, 16, 8]
    for two, steps in itertools.product((False, True), (1, 2)):
        network, _ = made((9, 30), border_mode="valid", nb_steps=steps, two_sublayers=two)
        for axis in network.borders:
            fits = []
            for points in range(1, axis.padded + 1):
                try:
                    given = torch.zeros(1, points, points, 1)
                    fits.append((points, network.predict({"input": given})["prediction"].shape[1]))
                except RuntimeError:  # no points are left somewhere
                    continue
            even = [
                points for points, left in fits if left >= axis.size and _halves(points, network)
            ]
            assert min(even) == axis.padded


def _halves(points, network):
    """Return whether no level loses a point when it is halved."""
    for _ in range(len(network.up)):
        points -= 2 * (len(network.down[0]) // 2)
        if points % 2:
            return False
        points //= 2
    return True


def test_channels_double_and_layers_follow_the_options():
    network = UNet(2, nb_input_channels=2, nb_first_layer_channels=4, nb_steps=2)
    convolutions = [m for m in network.down.modules() if isinstance(m, torch.nn.Conv2d)]
    shapes = [(m.in_channels, m.out_channels) for m in convolutions]
    assert shapes == [(2, 4), (4, 4), (4, 8), (8, 8), (8, 16), (16, 16)]
    assert [m.in_channels for m in network.up] == [16, 8]
    assert [level[0].in_channels for level in network.join] == [16, 8]
    single = UNet(3, nb_first_layer_channels=4, nb_steps=2, two_sublayers=False, skip_merge=True)
    assert [len(level) for level in single.down] == [2, 2, 2]
    assert [level[0].in_channels for level in single.join] == [8, 4]
    assert single.last.out_channels == 3


@pytest.mark.parametrize(
    ("normalization", "kind"),
    [("none", ()), ("batch", torch.nn.BatchNorm3d), ("group", torch.nn.GroupNorm)],
)
def test_normalization_and_activation_are_chosen(normalization, kind):
    network = UNet(
        3, nb_first_layer_channels=12, nb_steps=1, normalization=normalization, activation="PReLU"
    )
    found = [
        m for m in network.modules() if isinstance(m, (torch.nn.BatchNorm3d, torch.nn.GroupNorm))
    ]
    assert len(found) == (6 if kind else 0) and all(isinstance(module, kind) for module in found)
    if normalization == "group":
        assert [module.num_groups for module in found[:3]] == [4, 4, 8]
    slopes = [m.num_parameters for m in network.modules() if isinstance(m, torch.nn.PReLU)]
    assert slopes == [12, 12, 24, 24, 12, 12]


def test_batches_are_normalized_by_all_of_them_for_predictions():
    options = {"nb_output_channels": 1, "nb_first_layer_channels": 2, "border_mode": "same"}
    network = UNet(2, normalization="batch", nb_steps=1, **options)
    network.set_eval()
    grids = torch.randn(6, 4, 4, 1)
    whole = network.predict({"input": grids})["prediction"]
    parts = [network.predict({"input": grid[None]})["prediction"] for grid in grids]
    torch.testing.assert_close(whole, torch.cat(parts))
    network.set_train()
    assert not torch.allclose(network.predict({"input": grids[:2]})["prediction"], whole[:2])


def test_without_normalization_what_goes_through_keeps_its_size():
    torch.manual_seed(0)
    network = UNet(
        2, nb_output_channels=4, nb_first_layer_channels=32, nb_steps=3, border_mode="same"
    )
    output = network.forward(torch.randn(4, 32, 32, 1))
    assert 0.1 < output.std() < 10


def test_positions_tell_points_apart():
    plain, knowing = (
        made((8, 8), positions=positions, border_mode="same", nb_first_layer_channels=2)[0]
        for positions in (False, True)
    )
    assert knowing.down[0][0].in_channels == plain.down[0][0].in_channels + 2
    torch.manual_seed(0)
    network = UNet(2, positions=True, nb_output_channels=2, border_mode="same", nb_steps=1)
    seen = []
    network.down[0][0].register_forward_hook(lambda module, given, output: seen.append(given[0]))
    network.forward(torch.zeros(3, 4, 6, 1))
    (grids,) = seen
    assert grids.shape == (3, 3, 4, 6)
    assert torch.equal(grids[1, 1, :, 2], torch.linspace(-1, 1, 4))
    assert torch.equal(grids[2, 2, 3], torch.linspace(-1, 1, 6))


# Fields -----------------------------------------------------------------------------------------


def test_points_in_a_row_and_without_channels():
    size, rng = (4, 6), np.random.default_rng(0)
    fields = {"input": field_of("input", 24, 2), "ground_truth": field_of("ground_truth", *size)}
    network, transformation = made(size, 2, 1, fields, input_size=[4, 6])
    values = rng.random((3, *size, 2))
    flat = predicted(
        network, transformation, network.numpy_to_tensor({"input": values.reshape(3, 24, 2)})
    )["prediction"]
    assert flat.shape == (3, *size)
    fields["input"] = field_of("input", *size, 2)
    network.bind(fields)
    grid = predicted(network, transformation, network.numpy_to_tensor({"input": values}))
    torch.testing.assert_close(grid["prediction"], flat)


def test_several_fields_are_channels():
    size = (4, 4)
    fields = {
        "force": field_of("force", *size, 2),
        "fixed": field_of("fixed", *size),
        "move": field_of("move", *size, 2),
        "energy": field_of("energy", 16),
    }
    names = {"net_fields": ["force", "fixed"], "opt_fields": ["move", "energy"]}
    network, transformation = made(size, 3, 3, fields, **names)
    data = {"force": torch.rand(2, *size, 2), "fixed": torch.rand(2, *size)}
    prediction = predicted(network, transformation, data)
    assert {n: tuple(v.shape) for n, v in prediction.items()} == {
        "move": (2, 4, 4, 2),
        "energy": (2, 16),
    }


@pytest.mark.parametrize(
    ("shapes", "told"),
    [
        ({"input": (4, 4, 2), "ground_truth": (4, 4, 1)}, "nb_input_channels is 1 but must be 2"),
        ({"input": (4, 4, 1), "ground_truth": (4, 4, 2)}, "nb_output_channels is 1 but must be 2"),
        ({"input": (4, 4, 1), "ground_truth": (5, 4, 1)}, r"ground_truth.*not a grid of 4 x 4"),
        ({"input": (16,), "ground_truth": (4, 4, 1)}, "set input_size"),
    ],
)
def test_fields_that_are_no_grid_of_the_network(shapes, told):
    fields = {name: field_of(name, *shape) for name, shape in shapes.items()}
    with pytest.raises(FieldsMismatchError, match=told):
        made((4, 4), fields=fields)


@pytest.mark.parametrize(
    "options",
    [
        {"nb_dims": 1},
        {"nb_steps": 0},
        {"nb_first_layer_channels": 1.5},
        {"nb_input_channels": 0},
        {"border_mode": "full"},
        {"normalization": "layer"},
        {"data_scale": 0.0},
        {"input_size": [4]},
        {"input_size": [4, -4]},
    ],
)
def test_wrong_options_are_named(options):
    with pytest.raises(ConfigError, match=f"UNet.{next(iter(options))}"):
        UNet(**{"nb_dims": 2, **options})


def test_transformation_of_another_network():
    with pytest.raises(ConfigError, match="FC is not a UNet"):
        UNetTransformation().set_normalization({}, FC([2, 1]))


# Scale and normalization ------------------------------------------------------------------------


def test_scale_is_applied_to_targets_and_taken_back():
    size = (4, 4)
    rng = np.random.default_rng(0)
    coefficients = Normalization(rng.random((*size, 1)), 0.5 + rng.random((*size, 1)))
    _, transformation = made(size, data_scale=100.0, normalization={"ground_truth": coefficients})
    target = torch.rand(2, *size, 1)
    grid = torch.rand(2, *size, 1)
    prediction, targets = transformation.transform_before_loss(
        {"prediction": grid}, {"ground_truth": target}
    )
    assert prediction["prediction"].shape == (2, *size, 1)
    mean, std = (torch.from_numpy(part).float() for part in (coefficients.mean, coefficients.std))
    torch.testing.assert_close(targets["ground_truth"], 100 * (target - mean) / std)
    assert not targets["ground_truth"].requires_grad
    back = transformation.transform_before_apply({"prediction": targets["ground_truth"]})
    torch.testing.assert_close(back["prediction"], target)


# Learning ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "mode", "normalization"),
    [
        ((9, 10), "same", "none"),
        ((6, 5), "valid", "batch"),
        ((4, 5, 6), "same", "none"),
        ((4, 5, 6), "same", "group"),
    ],
)
def test_unet_learns_to_blur(size, mode, normalization, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    sharp = rng.standard_normal((96, *size, 1))
    blurred = sharp / 2
    for axis in range(1, len(size) + 1):
        blurred += (np.roll(sharp, 1, axis) + np.roll(sharp, -1, axis)) / 8
    with Dataset.create("data") as dataset:
        dataset.append("training", {"sharp": sharp[:80], "blurred": blurred[:80]})
        dataset.append("validation", {"sharp": sharp[80:], "blurred": blurred[80:]})
    network = NetworkConfig(
        "torch/unet",
        {
            "nb_dims": len(size),
            "nb_output_channels": 1,
            "nb_first_layer_channels": 4,
            "nb_steps": 1,
            "two_sublayers": False,
            "border_mode": mode,
            "normalization": normalization,
            "positions": len(size) == 3,
            "net_fields": "sharp",
            "opt_fields": "blurred",
        },
        loss="MSELoss",
        optimizer="Adam",
        lr=1e-2,
    )
    training = Training(
        network,
        DatasetConfig(existing_dir="data", normalize=True),
        epoch_nb=12,
        batch_size=8,
        seed=0,
    )
    training.execute()
    assert training.validation_loss < 0.2  # of a variance of 1
    inside = (slice(None), *[slice(1, -1)] * len(size))
    predictions = training.learner.predict_in_training({"sharp": sharp[80:]})["blurred"]
    assert predictions.shape == blurred[80:].shape
    error = (predictions - blurred[80:])[inside]
    assert np.mean(error**2) < 0.1 * np.var(blurred)
