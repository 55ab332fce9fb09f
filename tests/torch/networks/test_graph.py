"""Graph networks: from environments with meshes of any size to predictions in the loop."""

from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
    View,
)
from physx_core.errors import FieldsMismatchError
from physx_core.pipelines import load_learner

pytestmark = pytest.mark.processes

RODS = f"{Path(__file__).parents[1] / 'programs' / 'meshes.py'}:"
KWARGS = {
    "nodes": 2, "outputs": 1, "hidden": 8, "steps": 1,
    "net_fields": ["x", "edge", "load"], "opt_fields": "u",
}  # fmt: skip


def network(**changed):
    options = {"loss": "MSELoss", "optimizer": "Adam", "lr": 0.01}
    return NetworkConfig("torch/graph", network_kwargs={**KWARGS, **changed}, **options)


def generate(root, name, clients=0, writers="server"):
    environment = EnvironmentConfig(
        RODS + "Rods", as_tcp_ip_client=bool(clients), num_clients=max(1, clients), seed=3
    )
    DataGeneration(
        environment, dataset_config=DatasetConfig(writers=writers), episodes=12,
        session_dir=str(root), session_name=name, quiet=True,
    ).execute()  # fmt: skip
    return root / name


def train(root, data, name, epochs, **options):
    run = Training(
        network(), str(data), epoch_nb=epochs, batch_size=4, seed=1, session_dir=str(root),
        session_name=name, quiet=True, **options,
    )  # fmt: skip
    return run.execute()


def rows_of(folder):
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        mode = dataset["training"]
        fields = {name: [each.tolist() for each in mode[name]] for name in mode}
        once = dataset.episode_values("training", "geometry", slice(None))
        return fields, [each.tolist() for each in once]


def test_rows_of_free_axes_are_the_same_from_clients_and_from_clients_that_write(tmp_path):
    here = rows_of(generate(tmp_path, "here"))
    assert rows_of(generate(tmp_path, "sent", clients=2)) == here
    assert rows_of(generate(tmp_path, "written", clients=2, writers="clients")) == here


def test_graph_network_learns_resumes_and_predicts_in_the_loop(tmp_path):
    data = generate(tmp_path, "data")
    result = train(tmp_path, data, "whole", 4)
    errors = result.parts["validation"].fields["u"]
    assert errors.errors["rmse"] > 0 and "mean" in errors.rivals
    train(tmp_path, data, "parts", 2)
    train(tmp_path, data, "parts", 4, resume=True)
    rod = {"x": [np.array([[0.1], [0.7]])], "edge": [np.array([[0, 1]])], "load": np.ones(1)}
    whole, parts = (load_learner(tmp_path / name).predict(rod)["u"] for name in ("whole", "parts"))
    assert whole[0].tolist() == parts[0].tolist() and whole[0].shape == (2,)
    for clients in (0, 2):
        environment = EnvironmentConfig(
            RODS + "AskingRods", as_tcp_ip_client=bool(clients), num_clients=max(1, clients)
        )
        Prediction(
            NetworkConfig(), environment, session_dir=str(tmp_path), session_name="whole",
            step_nb=2, record=True, quiet=True,
        ).execute()  # fmt: skip
    with Dataset.open(tmp_path / "whole") as dataset:
        rows = dataset["prediction"]
        assert len(rows["x"]) == 6
        for x, u in zip(rows["x"], rows["predicted_u"], strict=True):
            assert len(x) == len(u)


def test_graph_network_learns_from_all_rows_of_a_window_at_once(tmp_path):
    data = generate(tmp_path, "data")
    windows = {f"{name}s": (name, [0, 1]) for name in ("x", "edge", "load", "u")}
    net = network(nodes=3, net_fields=["xs", "edges", "loads"], opt_fields="us")
    run = Training(
        net, DatasetConfig(existing_dir=str(data), view=View(window=windows)), epoch_nb=2,
        batch_size=4, seed=1, session_dir=str(tmp_path), session_name="net", quiet=True,
    )  # fmt: skip
    assert run.execute().parts["validation"].fields["us"].errors["rmse"] > 0
    two = {
        "xs": [np.array([[0.1], [0.7], [0.2], [0.5]])], "edges": [np.array([[0, 1], [2, 3]])],
        "loads": np.ones((1, 2)),
    }  # fmt: skip
    assert load_learner(tmp_path / "net").predict(two)["us"][0].shape == (4,)


def test_a_prediction_does_not_depend_on_the_other_graphs_of_a_batch(tmp_path):
    data = generate(tmp_path, "data")
    train(tmp_path, data, "net", 1)
    learner = load_learner(tmp_path / "net")
    with Dataset.open(data) as dataset:
        rows = {name: dataset["training"][name][:6] for name in ("x", "edge", "load")}
    together = learner.predict(rows)["u"]
    for row in range(6):
        alone = learner.predict({name: values[row : row + 1] for name, values in rows.items()})
        np.testing.assert_allclose(alone["u"][0], together[row], rtol=1e-4, atol=1e-6)


def test_the_report_draws_predicted_against_true_values_of_graphs_of_any_size(tmp_path):
    report = pytest.importorskip("physx_report")
    data = generate(tmp_path, "data")
    errors = train(tmp_path, data, "net", 1).parts["validation"].fields["u"]
    page = report.write_report(tmp_path / "net", trust=True).read_text(encoding="utf-8")
    assert "u. Predicted against true values. Best episode: " in page
    assert f"{errors.episodes['worst'].text}, error" in page


@pytest.mark.parametrize(
    ("changed", "match"),
    [({"nodes": 5}, "nodes"), ({"net_fields": ["x", "load"]}, "edges")],
)
def test_graph_network_says_what_does_not_fit(tmp_path, changed, match):
    data = generate(tmp_path, "data")
    run = Training(
        network(**changed), str(data), epoch_nb=1, batch_size=4, session_dir=str(tmp_path),
        session_name="net", quiet=True,
    )  # fmt: skip
    with pytest.raises(FieldsMismatchError, match=match):
        run.execute()
