"""What a training says of its network: errors on unseen episodes, and rivals without a network."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Optimization,
    Prediction,
    Replay,
    Result,
    Training,
    View,
    read_scalars,
)
from physx_core.errors import ConfigError, SessionError
from physx_core.results import PolicyResult, SettingResult, SweepResult, read_results
from physx_core.toy import Linear

RNG = np.random.default_rng(5)
MAP = RNG.normal(size=(3, 2))


class Nothing(Optimization):
    """Learns nothing."""

    def set_optimizer(self, optimizer, network, **kwargs):
        self.network = network

    def compute_loss(self, batch):
        return 1.0

    def optimize(self, loss):
        pass


class Planted(Linear):
    """Predicts what a function of the inputs returns."""

    default_optimization = Nothing

    def __init__(self, net_fields="x", opt_fields="y"):
        super().__init__(net_fields, opt_fields)

    def predict(self, data):
        return {self.pred_fields[0]: type(self).answer(data[self.net_fields[0]])}


def planted(function):
    return type("Chosen", (Planted,), {"answer": staticmethod(function)})


def store(x, y, episodes=50, fields=(), **more):
    """Store rows as episodes of equal length; 0: nothing is known of episodes."""
    rows = {"x": x, "y": y, **more}
    if episodes:
        number, step = np.divmod(np.arange(len(x)), len(x) // episodes)
        rows |= {"episode": number, "step": step}
    with Dataset.create("data") as dataset:
        if fields:
            dataset.define_fields("training", fields)
        dataset.append("training", rows)


def judged(network, **options):
    """Train for a batch, which changes nothing, and return the result."""
    given = {"epoch_nb": 1, "batch_nb": 1, "batch_size": 50, "seed": 0, "quiet": True}
    data = options.pop("data", "data")
    config = network if isinstance(network, NetworkConfig) else NetworkConfig(network)
    return Training(config, data, **{**given, **options}).execute()


def verdicts(result, field="y", part="validation"):
    rivals = result.parts[part].fields[field].rivals
    return {name: rival.verdict if rival.errors else "not run" for name, rival in rivals.items()}


def noisy(rows=1000, noise=0.3):
    x = RNG.normal(size=(rows, 3))
    return x, x @ MAP + noise * RNG.normal(size=(rows, 2))


# Planted truths ---------------------------------------------------------------------------------


def test_a_network_that_is_the_mean_is_no_better_than_the_mean_and_worse_than_a_linear_map():
    x, y = noisy()
    store(x, y)
    found = judged(planted(lambda x: np.zeros((len(x), 2)) + y.mean(axis=0)))
    assert verdicts(found) == {
        "mean": "even",
        "nothing changes": "not run",
        "linear map": "loses",
        "nearest neighbor": "loses",
    }
    rival = found.parts["validation"].fields["y"].rivals["linear map"]
    low, high = rival.interval
    assert low < rival.ratio < high
    assert rival.errors["rmse"] == pytest.approx(0.3, rel=0.1)


def test_a_network_that_is_the_linear_map_does_not_differ_from_it_and_beats_the_others():
    store(*noisy())
    found = verdicts(judged(planted(lambda x: x @ MAP)))
    assert found["linear map"] == "even"
    assert found["mean"] == found["nearest neighbor"] == "wins"


def test_a_network_that_looks_up_the_nearest_sample_does_not_differ_from_that():
    x = RNG.normal(size=(1000, 3))
    store(x, np.sin(3 * x[:, :2]))
    with View().open(50, data="data", fields=["x", "y"]) as batches:
        parts = [(batch["x"].copy(), batch["y"].copy()) for batch in batches]
    known, answers = (np.concatenate(each) for each in zip(*parts, strict=True))

    def look_up(x):
        away = np.square((x[:, None] - known) / known.std(axis=0)).sum(axis=2)
        return answers[away.argmin(axis=1)]

    found = verdicts(judged(planted(look_up)))
    assert found["nearest neighbor"] == "even"
    assert found["mean"] == found["linear map"] == "wins"


@pytest.mark.parametrize("better", [0.99, 0.5])
def test_of_six_episodes_nothing_is_said_however_much_better_the_network_is(better):
    x, y = noisy(600)
    store(x, y, episodes=30)
    right = {tuple(np.round(a, 9)): b for a, b in zip(x, y, strict=True)}
    center = y.mean(axis=0)

    def answer(x):
        truth = np.array([right[tuple(np.round(row, 9))] for row in np.asarray(x, float)])
        return truth + better * (center - truth)

    config = NetworkConfig(planted(answer), data_type="float64")
    found = judged(config)
    rival = found.parts["validation"].fields["y"].rivals["mean"]
    assert rival.verdict == "unknown"
    assert rival.ratio == pytest.approx(better, rel=0.02)
    assert rival.why == "too few trajectories to say: 6, fewer than 8"


def test_rows_of_one_trajectory_are_no_unseen_episodes():
    time = np.linspace(0, 40, 2000)
    x = np.stack([np.sin(time), np.cos(time), np.sin(3 * time)], axis=1)
    store(x, np.sin(2 * x[:, :2]), episodes=1)
    found = judged(planted(lambda x: np.sin(2 * x[:, :2])))
    rivals = found.parts["validation"].fields["y"].rivals
    assert not rivals["nearest neighbor"].errors
    assert set(verdicts(found).values()) == {"unknown", "not run"}


def test_rows_that_follow_one_another_are_suspected_where_nothing_is_known_of_episodes():
    time = np.linspace(0, 40, 2000)
    x = np.stack([np.sin(time), np.cos(time), np.sin(3 * time)], axis=1)
    store(x, np.sin(2 * x[:, :2]), episodes=0)
    found = judged(planted(lambda x: np.sin(2 * x[:, :2])))
    assert set(verdicts(found).values()) == {"unknown", "not run"}
    assert "consecutive rows are alike" in str(found)


def test_independent_rows_without_episodes_are_compared_by_blocks_but_not_with_neighbors():
    store(*noisy(), episodes=0)
    found = judged(planted(lambda x: x @ MAP))
    assert verdicts(found)["mean"] == "wins"
    assert verdicts(found)["nearest neighbor"] == "not run"
    assert "blocks of rows" in str(found)


def test_nothing_changes_is_a_rival_of_windows_of_one_field():
    walk = np.cumsum(RNG.normal(size=(50, 20, 2)), axis=1).reshape(1000, 2)
    store(walk, walk)
    view = View(window={"past": ("x", [-1, 0]), "next": ("x", [1, 2])})
    network = NetworkConfig(
        planted(lambda past: np.stack([past[:, 1]] * 2, axis=1)),
        network_kwargs={"net_fields": "past", "opt_fields": "next"},
    )
    found = judged(network, data=DatasetConfig(existing_dir="data", view=view))
    errors = found.parts["validation"].fields["next"].rivals["nothing changes"].errors
    assert errors["rmse"] == pytest.approx(found["error/next/rmse"], rel=1e-5)
    assert errors["rmse"] == pytest.approx(math.sqrt(1.5), rel=0.2)


def test_nothing_changes_is_a_rival_of_a_field_that_is_like_an_input():
    x = RNG.normal(size=(1000, 2))
    fields = [Field("x", (2,)), Field("y", (2,), like="x")]
    step = [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
    store(x, x + 0.1, fields=fields + step)
    found = judged(planted(lambda x: x), epoch_nb=1)
    rival = found.parts["validation"].fields["y"].rivals["nothing changes"]
    assert rival.errors["rmse"] == pytest.approx(0.1, rel=1e-4)


@pytest.mark.parametrize(
    ("off", "normalize", "advised"),
    [(0.5, False, True), (0.5, True, True), (0.1, False, False), (0.5, {"y": "increment"}, False)],
)
def test_a_network_worse_than_nothing_changing_may_learn_changes(off, normalize, advised, capfd):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(1000, 2))
    step = [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
    moved = x + rng.uniform(0.1, 0.2, x.shape)
    store(x, moved, fields=[Field("x", (2,)), Field("y", (2,), like="x"), *step])
    data = DatasetConfig(existing_dir="data", normalize=normalize)
    judged(planted(lambda x: x + off), data=data, quiet=False, session_name="net")
    advice = "next: physx train --config sessions/net --dataset.normalize.y increment"
    assert (advice in capfd.readouterr().err.splitlines()) is advised


# Errors -----------------------------------------------------------------------------------------


def test_errors_are_those_of_the_held_back_samples_in_physical_units():
    x, y = noisy()
    fields = [Field("x", (3,)), Field("y", (2,), unit="m")]
    fields += [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
    store(x, y, fields=fields)
    found = judged(planted(lambda x: x @ MAP), validation_batch_size=7)
    with View().open(50, data="data", part="validation") as held:
        rows = np.concatenate([held.rows(number)[0] for number in range(len(held))])
    error, truth = x[rows] @ MAP - y[rows], y[rows]
    of = found.parts["validation"].fields["y"]
    assert of.unit == "m"
    assert of.errors["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-5)
    assert of.errors["max"] == pytest.approx(np.abs(error).max(), rel=1e-5)
    each = [
        np.linalg.norm(error[rows // 20 == k]) / np.linalg.norm(truth[rows // 20 == k])
        for k in np.unique(rows // 20)
    ]
    assert found["error/y/relative_l2"] == pytest.approx(np.mean(each), rel=1e-5)
    assert [unit for _, unit in of.by_component] == ["m", "m"]
    errors = {k: np.sqrt(np.mean(error[rows // 20 == k] ** 2)) for k in np.unique(rows // 20)}
    worst = max(errors, key=errors.__getitem__)
    assert of.episodes["worst"].about["number"] == worst
    assert of.episodes["worst"].about["rows"] == 20
    assert of.episodes["worst"].error == pytest.approx(errors[worst], rel=1e-5)


def test_episodes_of_which_the_truth_is_nearly_zero_have_no_relative_error():
    x, y = noisy()
    y[np.arange(1000) // 20 % 2 == 0] *= 1e-6
    store(x, y)
    of = judged(planted(lambda x: x @ MAP)).parts["validation"].fields["y"]
    assert 0 < of.near_zero < 10
    assert math.isfinite(of.errors["relative_l2"])


@pytest.mark.parametrize("axis", [1, 2])
def test_classes_have_accuracies_and_a_confusion_and_the_most_frequent_class_as_rival(axis):
    x = RNG.normal(size=(1000, 3))
    truth = np.where(x[:, :2] > -0.5, 2, 0)
    truth[x[:, :2] > 1.5] = 1
    store(x, truth)

    def answer(x):
        label = np.where(x[:, :2] > 0, 2, 0)
        return np.stack([label == each for each in range(3)], axis=axis).astype(float)

    of = judged(planted(answer)).parts["validation"].fields["y"]
    assert of.kind == "classes" and of.classes == (0, 1, 2)
    confusion = np.array(of.confusion)
    assert confusion.sum() == 400 and confusion[:, 1].sum() == 0
    assert of.errors["accuracy"] == pytest.approx(confusion.diagonal().sum() / 400)
    recall = confusion.diagonal() / confusion.sum(axis=1)
    assert of.errors["balanced_accuracy"] == pytest.approx(recall.mean())
    frequent = of.rivals["most frequent class"]
    assert frequent.errors["accuracy"] == pytest.approx(confusion[2].sum() / 400)


def test_which_samples_chose_when_to_stop_is_written_beside_the_numbers():
    store(*noisy(), episodes=100)
    view = View(test_fold=1)
    data = DatasetConfig(existing_dir="data", view=view)
    found = judged(planted(lambda x: x @ MAP), data=data, epoch_nb=2, patience=5)
    assert found.parts["validation"].used == "when the training stopped"
    assert found.parts["test"].used == ""
    assert "test: 200 samples of 20 of 100 trajectories, which decided nothing" in str(found)
    assert verdicts(found, part="test")["mean"] == "wins"
    assert found["test/y/rmse"] == pytest.approx(0.3, rel=0.1)


# Results of all pipelines -----------------------------------------------------------------------


def test_a_result_is_stored_with_the_session_and_read_again():
    store(*noisy())
    found = judged(planted(lambda x: x @ MAP), session_name="run")
    assert read_results("sessions/run") == {"training": found}
    plain = json.loads(found.to_json())
    assert plain["parts"]["validation"]["fields"]["y"]["errors"]["rmse"] == found["error/y/rmse"]
    assert "<table>" in found._repr_html_() and "linear map" in found._repr_html_()
    with pytest.raises(KeyError, match="error/y/rmse"):
        found["error/y/rsme"]


def test_each_pipeline_returns_its_result():
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    generation = DataGeneration(spring, batch_nb=2, batch_size=10, session_name="a", quiet=True)
    made = generation.execute()
    assert made.kind == "data_generation" and "2 of 2 batches" in str(made)
    assert "20 training" in str(made)
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
    trained = Training(network, "sessions/a", epoch_nb=1, batch_size=10, quiet=True).execute()
    assert trained.places["checkpoint"].endswith("network_0")
    prediction = Prediction(NetworkConfig(), spring, step_nb=2, quiet=True)
    assert "2 steps" in str(prediction.execute())
    replay = Replay(DatasetConfig(existing_dir="sessions/a"), step_nb=3, quiet=True)
    assert isinstance(replay.execute(), Result)
    assert read_results("sessions/training").keys() == {"training", "prediction"}


def test_without_rivals_the_network_predicts_no_sample_more(monkeypatch):
    store(*noisy())
    calls = []

    def answer(x):
        calls.append(len(x))
        return x @ MAP

    found = judged(planted(answer), rivals="none")
    alone = len(calls)
    assert found.parts == {} and "rivals" in found.why
    judged(planted(answer))
    assert len(calls) > 2 * alone


def test_a_network_that_fails_while_it_is_judged_does_not_fail_the_training():
    store(*noisy())

    def answer(x):
        if len(x) != 50:
            raise RuntimeError("out of memory")
        return x @ MAP

    found = judged(planted(answer), validation_batch_size=64, validation_every=0)
    assert "out of memory" in found.why
    assert (found.places["checkpoint"]) and found.parts == {}


def test_a_damaged_file_of_results_is_named():
    store(*noisy())
    judged(planted(lambda x: x @ MAP), session_name="run")
    for content in (b"[1]", b'{"training": {"kind": 3}}', b'{"training": {"wrong": 3}}', b"{"):
        (Path("sessions/run/results.json")).write_bytes(content)
        with pytest.raises(SessionError, match=r"results\.json"):
            read_results("sessions/run")


# Monitor ----------------------------------------------------------------------------------------


class Drifting(Planted):
    """Gets better for two epochs, while its loss stays the same, and then worse."""

    epoch = 0

    def predict(self, data):
        return {"y": data["x"] @ MAP + abs(Drifting.epoch - 2)}


def drifting(**options):
    class Counting(Training):
        def epoch_begin(self):
            Drifting.epoch = self.epoch_id

    return Counting(
        NetworkConfig(Drifting), "data", epoch_nb=6, batch_nb=1, batch_size=50, quiet=True,
        **options,
    )  # fmt: skip


def test_an_error_in_physical_units_decides_which_network_is_the_best_and_when_to_stop():
    store(*noisy(noise=0))
    training = drifting(monitor="error/y/rmse", patience=2)
    found = training.execute()
    assert training.best.epoch == 3 and training.epoch_id == 5
    assert found["error/y/rmse/best"] == pytest.approx(0, abs=1e-5)
    curve = read_scalars(training.session.path)["epoch", "error/y/rmse"]
    assert list(curve.values()) == pytest.approx([2, 1, 0, 1, 2], abs=1e-5)
    assert found.parts["validation"].used == "when the training stopped"
    assert "smallest error/y/rmse" in str(found)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"monitor": "error/z/rmse"}, "Did you mean"),
        ({"monitor": "error/y/accuracy"}, "errors of this field are"),
        ({"monitor": "error/y/rmse", "validation_every": 0}, "nothing is validated"),
    ],
)
def test_what_cannot_be_monitored_is_refused(options, reason):
    store(*noisy())
    with pytest.raises(ConfigError, match=reason):
        drifting(**options).execute()


def test_of_an_accuracy_the_largest_decides():
    x = RNG.normal(size=(1000, 3))
    store(x, x[:, :2] > 0)
    training = drifting(monitor="error/y/accuracy")
    training.network_config = NetworkConfig(
        type("Chosen", (Drifting,), {"predict": lambda self, data: {
            "y": (data["x"][:, :2] > abs(Drifting.epoch - 2)).astype(float)}})
    )  # fmt: skip
    found = training.execute()
    assert training.best.epoch == 3
    assert found["error/y/accuracy/best"] == 1.0
    assert "largest error/y/accuracy 1, after epoch 3" in str(found)


# Metrics ----------------------------------------------------------------------------------------


def largest_drift(prediction, truth):
    """Return the largest change of the error within an episode of 20 rows."""
    assert set(prediction) == {"y"} and set(truth) == {"x", "y"} and len(truth["x"]) == 20
    error = prediction["y"] - truth["y"]
    return np.ptp(error[:, 0])


def step_accuracy(prediction, truth):
    return 1.0 / (1.0 + np.abs(prediction["y"] - truth["y"]).max())


def test_metrics_of_the_user_are_means_over_whole_episodes_whatever_the_batches():
    x, y = noisy()
    store(x, y)
    data = DatasetConfig(existing_dir="data", view=View(test_fold=1))
    network, values = planted(lambda x: x @ MAP), []
    for number, size in enumerate((7, 20, 1000)):
        found = judged(
            network, metrics=[largest_drift, step_accuracy], validation_batch_size=size,
            session_name=f"run{number}", data=data,
        )  # fmt: skip
        values.append([found[f"{part}metric/largest_drift"] for part in ("", "test/")])
        curve = read_scalars(Path(found.session))["epoch", "metric/largest_drift"]
        assert curve == {1: pytest.approx(values[-1][0])}
    drifts = np.ptp((x @ MAP - y)[:, 0].reshape(50, 20), axis=1)
    assert np.ptp(values, axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert drifts.min() < values[0][0] < drifts.max()
    assert "largest_drift: " in str(found) and "the mean over 10 episodes" in str(found)
    assert read_results(found.session)["training"].parts == found.parts


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.reported(
    "pytorch-lightning#3732",
    "keras#11440",
    "scvi-tools#359",
    about="one's own error decides which network is the best, and when to stop",
)
def test_a_metric_decides_which_network_is_the_best(interleaved):
    x, y = noisy(noise=0)
    number, step = np.divmod(np.arange(1000), 20)
    if interleaved:  # the rows of several streams
        number, step = step, number
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x, "y": y, "episode": number, "step": step})
    training = drifting(monitor="metric/step_accuracy", metrics=[step_accuracy])
    found = training.execute()
    assert training.best.epoch == 3
    assert found["metric/step_accuracy/best"] == pytest.approx(1, abs=1e-5)
    assert "largest metric/step_accuracy 1" in str(found)


def no_number(prediction, truth):
    return prediction["y"]


@pytest.mark.parametrize(
    ("metrics", "reason"),
    [
        (["drag"], "name one as"),
        ([5], "not callable"),
        ([largest_drift, largest_drift], "two functions"),
        (["physx_core.toy:Lineer"], 'Did you mean "Linear"'),
        ([no_number], "no_number must return a number for each episode"),
    ],
)
def test_metrics_that_are_none_are_refused(metrics, reason):
    store(*noisy())
    with pytest.raises(ConfigError, match=reason):
        drifting(metrics=metrics).execute()


# Rivals of the user -----------------------------------------------------------------------------


def law(inputs):
    """Know the law without a network."""
    return inputs["x"] @ MAP


def short(inputs):
    return inputs["x"][:, :1]


def broken(inputs):
    return inputs["z"]


def other(inputs):
    return {"z": inputs["x"]}


def test_a_rival_of_the_user_is_compared_like_any_other():
    x, y = noisy()
    store(x, y)
    network = planted(lambda x: x @ MAP + 0.1)
    Path("zero.py").write_text("def zero(inputs):\n    return {'y': 0 * inputs['x'][:, :2]}\n")
    found = judged(network, rivals=["all", law, "zero.py:zero"])
    said = verdicts(found)
    assert (said["law"], said["zero"], said["mean"]) == ("loses", "wins", "wins")
    of = found.parts["validation"].fields["y"].rivals
    assert of["law"].errors["rmse"] == pytest.approx(0.3, rel=0.1)
    only = judged(network, rivals=[law])
    assert list(verdicts(only)) == ["law"]
    alone = judged(network, rivals=[])
    assert verdicts(alone) == {} and alone["error/y/rmse"] == found["error/y/rmse"]


def test_a_rival_of_the_user_that_fails_is_named_and_the_others_are_compared():
    store(*noisy())
    found = judged(planted(lambda x: x @ MAP), rivals=[short, broken, other, law])
    of = found.parts["validation"].fields["y"].rivals
    assert "it returned the shape (50, 1) where the field has (50, 2)" in of["short"].why
    assert "it failed: KeyError('z')" in of["broken"].why
    assert of["other"].why == "it does not predict this field"
    assert of["law"].errors and not of["short"].errors


@pytest.mark.parametrize(
    ("rivals", "reason"),
    [
        (["drag"], "name one as"),
        ("nun", "name one as"),
        ([law, law], "two functions"),
        (["physx_core.toy:Lineer"], 'Did you mean "Linear"'),
    ],
)
def test_rivals_that_are_none_are_refused(rivals, reason):
    store(*noisy())
    with pytest.raises(ConfigError, match=reason):
        judged(planted(lambda x: x @ MAP), rivals=rivals)


def test_a_policy_is_better_only_if_neither_chance_of_episodes_nor_of_signs_explains_it():
    random = np.random.default_rng(0)
    rewards = random.normal(size=12)
    own = {"seed": range(12), "reward": rewards}
    rivals = {
        "worse": rewards - 1 - random.uniform(size=12),
        "better": rewards + 2,
        "the same": rewards,
        "noise": rewards + random.normal(size=12),
    }
    found = PolicyResult.of("Swing-v0", "", "network_1", own, rivals)
    assert [each.verdict for each in found.rivals.values()] == ["wins", "loses", "even", "even"]
    assert found.interval[0] < found.values["reward"] < found.interval[1]
    few = {name: values[:7] for name, values in own.items()}
    found = PolicyResult.of("Swing-v0", "", "network_1", few, {"better": rewards[:7] + 2})
    assert found.rivals["better"].verdict == "unknown" and found.interval is None
    assert "too few episodes to say: 7, fewer than 8" in "\n".join(found.lines("Swing-v0"))


def test_the_best_setting_of_a_sweep_has_a_number_for_each_seed():
    settings = [
        SettingResult("a", {"lr": 0.1}, {"0": 1.0, "1": 3.0}),
        SettingResult("a", {"lr": 0.2}, {"0": 0.5}, {"1": "pruned"}),
        SettingResult("a", {"lr": 0.3}, {"0": 3.0, "1": 3.0}),
    ]
    for goal, place in (("minimize", 0), ("maximize", 2)):
        found = Result("sweep", "study", 1.0, sweep=SweepResult("loss", goal, settings))
        assert found.sweep.best == settings[place] and found["best"] == settings[place].value
    assert settings[0].spread == pytest.approx(2**0.5) and settings[1].spread is None
    assert "1 other settings" in str(found)
