"""The file of a study: what it may say, and what its errors say."""

from pathlib import Path

import numpy as np
import pytest

from physx_cluster.sweep import Definition, Study
from physx_cluster.sweep.parameters import Choices, Range, grid_of, read_parameters
from physx_core.errors import ConfigError

LINEAR = """
[pipelines.linear.training]
epoch_nb = 2
batch_size = 10
[pipelines.linear.training.network]
network = "toy/linear"
"""


def message(text):
    """Return the error that a file's text leads to; it names the file."""
    Path("sweep.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        Definition.read(Path("sweep.toml"))
    assert "sweep.toml" in str(caught.value)
    return str(caught.value)


def plus(table, text, base=LINEAR):
    return f"[{table}]\n{text}\n{base}"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[study", ["not valid TOML"]),
        ("", ["no table [pipelines.NAME.training]"]),
        ("study = 3\n" + LINEAR, ["must be a table: [study]"]),
        (plus("stdy", ""), ['has no option "stdy"', 'Did you mean "study"?']),
        (plus("study", "smapler = 'grid'"), ["[study]", '"smapler"', 'Did you mean "sampler"?']),
        (plus("study", "batch = 0"), ["[study] batch is 0 but must be at least 1"]),
        (plus("study", "goal = 'minimise'"), ["[study] goal is 'minimise'", "'maximize'"]),
        (plus("study", "seeds = []"), ["[study] seeds is []"]),
        (plus("study", "seeds = [1, 1]"), ["must list distinct numbers"]),
        (plus("study", "trials = 3"), ["a grid is always complete"]),
        (plus("study", "sampler = 'random'"), ["trials is missing"]),
        (plus("study", "sampler_kwargs = {a = 1}"), ['not for "grid"']),
        (plus("study", "pruner_kwargs = {a = 1}"), ["without a pruner"]),
        (plus("run", "executor = 'slrm'"), ["[run] executor: ", 'Did you mean "slurm"?']),
        (plus("run", "paralell = 2"), ["[run]", 'Did you mean "parallel"?']),
        (plus("parameters", "training.network.lr = 3"), ["[parameters]: training.network.lr is 3"]),
        (plus("parameters", "training.network.lr = []"), ["must be a list of values"]),
        (
            plus("parameters", "training.network.lr = {low = 1.0}"),
            ["training.network.lr", "missing 1 required", "high"],
        ),
        (
            plus(
                "parameters", "training.network.lr = {low = 1.0, high = 2.0, num = 3, logs = true}"
            ),
            ["training.network.lr", 'Did you mean "log"?'],
        ),
        (
            plus("parameters", "training.network.lr = {low = 2.0, high = 1.0, num = 3}"),
            ["must be below high"],
        ),
        (
            plus(
                "parameters", "training.network.lr = {low = 0.0, high = 1.0, num = 3, log = true}"
            ),
            ["must be positive where log is true"],
        ),
        (
            plus("parameters", "training.network.lrr = [0.1]"),
            ["[pipelines.linear]", 'NetworkConfig has no option "lrr"', 'Did you mean "lr"?'],
        ),
        (
            plus("parameters", "trainng.network.lr = [0.1]"),
            ["trainng.network.lr", 'Did you mean "training"?'],
        ),
        (
            plus("parameters", "training.batch_size = [10, 0]"),
            ["with training.batch_size = 0", "must be at least 1"],
        ),
        (
            plus("parameters", "training.batch_size.half = [10]"),
            ["training.batch_size.half", "which is not a table"],
        ),
        (LINEAR.replace("epoch_nb", "epochs"), ["[pipelines.linear]", '"epochs"', "epoch_nb"]),
        (
            LINEAR.replace("toy/linear", "toy/liner"),
            ['no network "liner"', 'Did you mean "linear"?'],
        ),
        (LINEAR.replace(".training", ".trainnig"), ["[pipelines.linear]", '"trainnig"']),
        (
            "[pipelines.a.data_generation]\nbatch_nb = 1",
            ["no table [pipelines.a.training]", "data_generation"],
        ),
        (
            LINEAR + "[pipelines.linear.training.environment]\nnum_clients = 2",
            ["does not name the environment"],
        ),
    ],
)
def test_errors_name_file_table_and_option(text, parts):
    said = message(text)
    for part in parts:
        assert part in said


def test_a_range_without_a_number_of_values_has_no_grid(tmp_path):
    Path("sweep.toml").write_text(
        plus("parameters", "training.network.lr = {low = 0.1, high = 1.0}")
    )
    definition = Definition.read(Path("sweep.toml"))
    with pytest.raises(ConfigError, match=r"training.network.lr: .* add num = 5"):
        Study.open(Path("study"), definition)


THOUSAND = "{ low = 1, high = 1000, num = 1000 }"
BILLION = f"""[parameters]
training.network.lr = {{ low = 1e-4, high = 0.1, log = true, num = 1000 }}
training.batch_size = {THOUSAND}
training.epoch_nb = {THOUSAND}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "told"),
    [
        (BILLION + LINEAR, "has 1000000000 trials .* sampler = .random."),
        (
            plus("parameters", "training.network.lr = {low = 0.1, high = 1.0, num = 10000000000}"),
            "has 10000000000 trials",
        ),
        (
            plus("study", "sampler = 'random'\ntrials = 1000000000"),
            "has 1000000000 trials .* study.trials",
        ),
        (plus("study", f"seeds = {list(range(200_000))}"), "has 200000 trials .* fewer seeds"),
        (
            plus("study", "sampler = 'random'\ntrials = 60000", LINEAR)
            + LINEAR.replace("linear.", "other."),
            "has 120000 trials",
        ),
    ],
)
def test_trials_are_counted_before_they_are_built(text, told):
    Path("sweep.toml").write_text(text)
    definition = Definition.read(Path("sweep.toml"))
    with pytest.raises(ConfigError, match=f"sweep {told}"):
        Study.open(Path("study"), definition)
    assert not Path("study").exists()


def test_integers_that_round_alike_are_counted_once():
    few = "{ low = 1, high = 3, num = 1000 }"
    text = f"training.batch_size = {few}\ntraining.epoch_nb = {few}\ntraining.seed = {few}"
    Path("sweep.toml").write_text(plus("parameters", text))
    Study.open(Path("study"), Definition.read(Path("sweep.toml"))).close()


def test_parameters_of_a_pipeline_add_to_those_of_all():
    text = """
    [parameters]
    training.network.lr = [0.1]
    training.batch_size = [5]
    [pipelines.linear.parameters]
    training.batch_size = [10, 20]
    training.network.network_kwargs = { net_fields = [["state"], ["state", "force"]] }
    """
    Path("sweep.toml").write_text(text + LINEAR)
    definition = Definition.read(Path("sweep.toml"))
    pipeline = definition.pipelines["linear"]
    assert pipeline.parameters["training.batch_size"] == Choices((10, 20))
    last = grid_of(pipeline.parameters)[-1]
    tables = pipeline.with_setting(last, seed=3)
    assert tables["training"] == {
        "epoch_nb": 2,
        "batch_size": 20,
        "seed": 3,
        "network": {
            "network": "toy/linear",
            "lr": 0.1,
            "network_kwargs": {"net_fields": ["state", "force"]},
        },
    }
    assert "lr" not in pipeline.stages["training"]["network"]  # the file's table is left alone


def test_grids_hold_both_ends():
    assert Range(1, 4, num=4).grid() == [1, 2, 3, 4]
    assert Range(1, 2, num=9).grid() == [1, 2]
    values = Range(1e-4, 1e-1, log=True, num=4).grid()
    np.testing.assert_allclose(values, [1e-4, 1e-3, 1e-2, 1e-1], rtol=1e-12)
    assert (values[0], values[-1]) == (1e-4, 1e-1)


def test_random_numbers_fill_their_range():
    random = np.random.default_rng(0)
    whole = [Range(1, 3).draw(random) for _ in range(600)]
    assert {whole.count(n) > 150 for n in (1, 2, 3)} == {True}
    logs = np.log10([Range(1e-4, 1.0, log=True).draw(random) for _ in range(600)])
    assert logs.min() >= -4
    assert logs.max() <= 0
    assert np.abs(np.histogram(logs, 4)[0] - 150).max() < 50
    assert {Choices(("a", "b")).draw(random) for _ in range(50)} == {"a", "b"}


def test_paths_may_be_written_with_dots_or_as_tables():
    flat = read_parameters("", {"training.network.lr": [1.0]})
    nested = read_parameters("", {"training": {"network": {"lr": [1.0]}}})
    assert flat == nested == {"training.network.lr": Choices((1.0,))}
