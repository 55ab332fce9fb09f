"""What the examples share: the cloud, the network for it, and how networks are judged."""

import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")


@pytest.fixture(autouse=True)
def beside_the_examples(root, monkeypatch):
    """Modules are found as from a script in the folder of the examples, and forgotten again."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(root / "examples"))
    yield
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("common", "environments", "networks"):
            del sys.modules[name]


def clouds(count):
    from environments.cloud import Cloud

    cloud = Cloud(instance_id=1, seed=0)
    for _ in range(count):
        cloud.draw()
        yield cloud.points.copy(), cloud.spread.copy()


def test_the_spread_is_that_of_the_covariance_and_depends_on_neither_place_nor_order():
    for points, spread in clouds(20):
        variances = np.linalg.eigvalsh(np.cov(points.T, bias=True))
        np.testing.assert_allclose(spread, np.sqrt(variances[::-1]), rtol=1e-6)


@pytest.mark.slow
def test_the_deep_set_depends_on_neither_place_nor_order():
    from networks.deep_set import DeepSet

    torch.manual_seed(0)
    network = DeepSet(16, 3)
    points = torch.tensor(np.array([each for each, _ in clouds(5)]), dtype=torch.float32)
    moved = points[:, torch.randperm(points.shape[1])] + torch.tensor([3.0, -1.0, 2.0])
    with torch.no_grad():
        said, again = network(points), network(moved)
    assert said.shape == (5, 3) and said.std() > 0
    torch.testing.assert_close(again, said, rtol=1e-4, atol=1e-5)


def test_a_linear_map_is_found_exactly():
    from common import linear_map

    rng = np.random.default_rng(0)
    inputs, turn = rng.normal(size=(200, 2, 3)), rng.normal(size=(6, 4))
    outputs = (inputs.reshape(200, 6) @ turn + 1).reshape(200, 2, 2)
    guess = linear_map(inputs[:150], outputs[:150])(inputs[150:])
    np.testing.assert_allclose(guess, outputs[150:], rtol=1e-9)


@pytest.mark.parametrize("wide", [0.1, 900.0])
def test_a_small_run_is_not_judged(wide, capsys):
    from common import conclude

    from physx_core import Comparison

    compared = Comparison({"linear map": [1.0], "wide": [wide]}, "wide")
    assert conclude(compared, small=True) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1].startswith("Too small to judge: ")
    assert "linear map" in out and "times" not in out
    assert conclude(compared, small=False) == int(wide > 1)
    assert "best rival, linear map" in capsys.readouterr().out


def test_samples_to_test_with_are_others_than_those_to_learn_from(tmp_path):
    from common import generate, samples
    from environments.cloud import Cloud

    session = generate(Cloud, 50, tmp_path, as_tcp_ip_client=False)
    learned, tested = (samples(session, mode, "input")[0] for mode in ("training", "validation"))
    assert len(learned) == 50 and len(tested) == 10
    assert not {each.tobytes() for each in learned} & {each.tobytes() for each in tested}
