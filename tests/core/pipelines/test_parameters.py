"""Environments get parameters from a sampler, and the dataset says which."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Parameter,
    Prediction,
    Training,
)
from physx_core.cli import main
from physx_core.components import Environment, Sampler
from physx_core.errors import (
    ConfigError,
    DatasetError,
    EnvironmentFailedError,
    FieldsMismatchError,
    UnknownOptionError,
    UsageError,
)

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "parameter_envs.py"
SWING = f"{ENVS}:Swing"


def generate(folder, *, clients=True, batch_nb=4, batch_size=10, kwargs=None, **options):
    of_run = {name: options.pop(name) for name in ("mode", "new_session") if name in options}
    settings = {"num_clients": 2, "seed": 3, "as_tcp_ip_client": clients, **options}
    config = EnvironmentConfig(
        settings.pop("environment", SWING), env_kwargs=kwargs or {}, **settings
    )
    run = DataGeneration(
        config,
        session_dir=str(folder),
        batch_nb=batch_nb,
        batch_size=batch_size,
        quiet=True,
        **of_run,
    )
    run.execute()
    return run


def content(run, mode="training"):
    with Dataset.open(run.session.dataset_dir) as dataset:
        return {name: dataset[mode][name][:] for name in dataset.fields(mode)}


def equal(one, other):
    assert list(one) == list(other)
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


def check_sets_explain_rows(rows, sets, instance_nb):
    """Check that each row has the parameters that are recorded for its episode."""
    numbers = rows["episode"] * instance_nb + rows["env_id"] - 1
    assert sorted({*sets["set"].tolist()}) == sorted(sets["set"].tolist())
    assert {*numbers.tolist()} <= {*sets["set"].tolist()}
    places = np.array([sets["set"].tolist().index(number) for number in numbers])
    assert (rows["x"][:, 0] == sets["stiffness"][places]).all()
    assert (rows["x"][:, 1:] == sets["push"][places]).all()
    begun = list(dict.fromkeys(numbers.tolist()))
    assert [n for n in sets["set"].tolist() if n in begun] == begun


@pytest.mark.parametrize("sampler", [None, "physx/sobol", "physx/grid"])
def test_rows_and_parameters_are_the_same_in_process_and_in_clients(tmp_path, sampler):
    runs = [generate(tmp_path, clients=clients, sampler=sampler) for clients in (False, True)]
    for mode in ("training", "parameters"):
        equal(*(content(run, mode) for run in runs))
    rows, sets = (content(runs[0], mode) for mode in ("training", "parameters"))
    check_sets_explain_rows(rows, sets, 2)
    assert sets["set"].tolist() == list(range(14))
    assert len({*rows["noise"].tolist()}) == 40


def test_an_episode_depends_on_its_set_alone(tmp_path):
    """With other numbers of instances the sets, and with them all episodes, are the same."""
    found = []
    for instance_nb in (1, 3):
        run = generate(tmp_path, clients=False, num_clients=instance_nb, batch_size=9)
        rows = content(run)
        numbers = rows["episode"] * instance_nb + rows["env_id"] - 1
        found.append(
            {n: np.c_[rows["x"], rows["noise"]][numbers == n].tolist() for n in numbers.tolist()}
        )
    assert found[0] == found[1]


def test_sets_and_batches_do_not_depend_on_each_other(tmp_path):
    runs = [
        generate(tmp_path, clients=False, batch_nb=nb, batch_size=size)
        for nb, size in ((1, 40), (40, 1), (5, 8))
    ]
    for run in runs[1:]:
        equal(content(run, "parameters"), content(runs[0], "parameters"))


def test_a_training_records_the_parameters_of_its_samples(tmp_path):
    config = EnvironmentConfig(SWING, num_clients=2, seed=3, sampler="physx/sobol")
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    run = Training(
        network, None, config, session_dir=str(tmp_path), epoch_nb=2, batch_nb=3, batch_size=10,
        quiet=True, seed=5,
    )  # fmt: skip
    run.execute()
    check_sets_explain_rows(content(run), content(run, "parameters"), 2)
    assert run.data.dataset.info["sampler"] == "physx/sobol"


def test_a_prediction_gives_parameters_too(tmp_path):
    test_a_training_records_the_parameters_of_its_samples(tmp_path)
    config = EnvironmentConfig(SWING, num_clients=2, seed=3, as_tcp_ip_client=False)
    run = Prediction(
        NetworkConfig(), config, session_dir=str(tmp_path), step_nb=4, record=True, quiet=True
    )
    run.execute()
    rows = content(run, "prediction")
    assert len(np.unique(rows["x"], axis=0)) == 4


def test_the_command_line_chooses_the_sampler(tmp_path, capsys):
    table = tmp_path / "sets.csv"
    table.write_text("stiffness,push_0,push_1\n11,0,1\n12,0,1\n13,0,1\n")
    words = f"generate {SWING} --session-dir {tmp_path} --session-name run --batch-nb 2"
    words += f" --batch-size 6 --environment.seed 1 --environment.sampler-kwargs file={table}"
    assert main([*words.split(), "--environment.sampler", "physx/table"]) == 0
    with Dataset.open(tmp_path / "run" / "dataset") as dataset:
        assert dataset["parameters"]["stiffness"][:].tolist() == [11, 12, 13, 11]
    assert "4 parameters" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "run")]) == 0
    assert main(["verify", str(tmp_path / "run")]) == 0


def test_restarted_client_gets_same_parameters(tmp_path):
    kwargs = {"how": "once", "folder": str(tmp_path)}
    failing = generate(tmp_path, retries=1, sampler="physx/sobol", kwargs=kwargs)
    whole = generate(tmp_path, clients=False, sampler="physx/sobol")
    assert len(list(tmp_path.glob("died_*"))) == 2
    for mode in ("training", "parameters"):
        equal(content(failing, mode), content(whole, mode))


@pytest.mark.parametrize("clients", [False, True])
def test_error_of_a_stream_names_its_parameters(tmp_path, clients):
    config = EnvironmentConfig(
        SWING, env_kwargs={"fails_above": 11.0}, seed=3, as_tcp_ip_client=clients
    )
    run = DataGeneration(config, session_dir=str(tmp_path), batch_nb=9, batch_size=1, quiet=True)
    with pytest.raises(EnvironmentFailedError, match="it broke") as error:
        run.execute()
    assert any("set 0: stiffness=" in note for note in error.value.__notes__)


def test_an_error_of_the_sampler_ends_the_run(tmp_path):
    with pytest.raises(ConfigError, match="on purpose"):
        generate(tmp_path, clients=False, sampler=Broken)


# Errors ---------------------------------------------------------------------------------------


class Broken(Sampler):
    """Fails after the second set."""

    def ask(self, number):
        if number > 2:
            raise RuntimeError("on purpose")
        return {"stiffness": 20.0, "push": [0.0, 1.0]}


class Misfit(Sampler):
    """Chooses what its option says."""

    def __init__(self, values):
        self.chosen = values

    def ask(self, number):
        return self.chosen


class Late(Environment):
    """Defines parameters too late, twice, or not in all instances, or lacks `reset_parameters`."""

    def __init__(self, *, how, **kwargs):
        super().__init__(**kwargs)
        self.how = how

    def create(self):
        if self.how != "late" and not (self.how == "one" and self.instance_id == 2):
            self.define_parameters(Parameter("a", 0.0, 1.0))
        if self.how == "twice":
            self.define_parameters(Parameter("a", 0.0, 1.0))
        if self.how == "number":
            self.define_parameters([3])

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.define_parameters(Parameter("a", 0.0, 1.0))


@pytest.mark.parametrize("clients", [False, True])
def test_a_sampler_for_an_environment_without_parameters_is_an_error(tmp_path, clients):
    with pytest.raises(ConfigError, match=r"defines no parameters: call define_parameters\(\)"):
        generate(tmp_path, environment=f"{ENVS}:Plain", clients=clients, sampler="physx/sobol")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stiffness": 20.0}, "the parameters are"),
        ({"stiffness": 20.0, "push": [1.0]}, "does not fit"),
        ({"stiffness": np.nan, "push": [0.0, 0.0]}, "not finite"),
        (7, "chose 7"),
    ],
)
@pytest.mark.parametrize("clients", [False, True])
def test_a_choice_that_does_not_fit_is_an_error(tmp_path, values, message, clients):
    with pytest.raises(ConfigError, match=message):
        generate(tmp_path, clients=clients, sampler=Misfit, sampler_kwargs={"values": values})


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ("late", UsageError, "after the first step"),
        ("twice", ConfigError, '"a" is defined twice'),
        ("number", ConfigError, "define_parameters.. got 3"),
        ("one", FieldsMismatchError, "Instances 1 and 2"),
        ("", UsageError, r"does not implement reset_parameters\(\)"),
    ],
)
def test_definitions_that_do_not_work_are_errors(tmp_path, how, error, message):
    with pytest.raises(error, match=message):
        generate(tmp_path, environment=Late, clients=False, kwargs={"how": how})


def test_options_that_do_not_exist_or_fit_are_errors(tmp_path):
    with pytest.raises(UnknownOptionError, match='"point".*Did you mean "points"'):
        generate(tmp_path, sampler="physx/grid", sampler_kwargs={"point": 3})
    with pytest.raises(ConfigError, match="without a sampler"):
        generate(tmp_path, sampler_kwargs={"points": 3})


AGAIN = f"{ENVS}:Again"


def replay(folder, existing, *, clients=False, environment=AGAIN, instances=2, **options):
    config = EnvironmentConfig(
        environment, num_clients=instances, seed=8, as_tcp_ip_client=clients, load_samples=True,
        only_first_epoch=False,
    )  # fmt: skip
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    run = Training(
        network, DatasetConfig(existing_dir=existing, **options), config, batch_size=7, epoch_nb=2,
        session_dir=str(folder), session_name="replayed", seed=5, quiet=True,
    )  # fmt: skip
    run.execute()
    return run


@pytest.mark.parametrize("clients", [False, True])
def test_a_stored_row_is_replayed_with_the_parameters_that_it_was_made_with(tmp_path, clients):
    """Also if its run was not the only one, and others replay it."""
    options = {"clients": False}
    with pytest.raises(EnvironmentFailedError):  # has neither sets nor rows
        generate(tmp_path, clients=False, kwargs={"fails_above": 0.0}, batch_nb=1)
    for seed, mode in ((1, "training"), (2, "validation"), (3, "training")):
        made = generate(tmp_path, mode=mode, seed=seed, new_session=False, **options)
    sets = content(made, "parameters")
    run = replay(tmp_path, made.session.path, clients=clients, instances=3)
    before, after = content(made), content(run)
    assert before["x"].tobytes() == after["x"].tobytes()
    assert (after["noise"] == before["noise"] + 2).all()
    equal(sets, content(run, "parameters"))  # no new ones


def test_predictions_replay_with_stored_parameters_too(tmp_path):
    made = generate(tmp_path, clients=False)
    run = replay(tmp_path, made.session.path)
    config = EnvironmentConfig(AGAIN, seed=3, as_tcp_ip_client=False, load_samples=True)
    Prediction(
        NetworkConfig(), config, DatasetConfig(existing_dir=made.session.path), quiet=True,
        session_dir=str(tmp_path), session_name=run.session.name, step_nb=30,
    ).execute()  # fmt: skip


def test_where_it_is_not_known_with_which_parameters_rows_were_made_a_replay_is_refused(tmp_path):
    made = generate(tmp_path, clients=False, batch_nb=1)
    with Dataset.open(made.session.path, writable=True) as dataset:
        dataset.append("training", content(made))  # as another run, without its sets
    with pytest.raises(
        DatasetError, match="come from 2 runs, but their recorded parameters from 1, so"
    ):
        replay(tmp_path, made.session.path)
