"""The mistakes that beginners make: each ends soon, in one clear error, and nothing is lost.

The table is the list of functions below: each makes one mistake; its decorator says which error
it ends in and what the message contains.
"""

from __future__ import annotations

import dataclasses
import shutil
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Network,
    NetworkConfig,
    Optimization,
    PhysxError,
    Prediction,
    Training,
    Transformation,
    Visualizer,
    evaluate,
    read_scalars,
)
from physx_core import errors as e
from physx_core.pipelines import Replay
from physx_core.toy import LeastSquares, Linear

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parent / "programs" / "mistaken_envs.py"
KEPT = DatasetConfig(existing_dir="sessions/kept")
LINEAR = NetworkConfig("toy/linear")
TABLE = []


def mistake(error, *fragments):
    """Add a function to the table."""

    def add(function):
        TABLE.append(pytest.param(function, error, fragments, id=function.__name__))
        return function

    return add


def content(session):
    """Return the files of a session's dataset, all but the index for other tools, and networks."""
    return {
        path: path.read_bytes()
        for part in ("dataset", "network")
        for path in Path("sessions", session, part).rglob("*")
        if path.is_file() and path.name not in (f"{session}.h5", "dataset.lock")
    }


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A session with twenty samples and a trained network."""
    place = tmp_path_factory.mktemp("stored")
    generate(Good, session_dir=str(place), session_name="kept", batch_nb=2, batch_size=10)
    Training(
        LINEAR, DatasetConfig(existing_dir=str(place / "kept")), epoch_nb=1, batch_size=10,
        session_dir=str(place), session_name="trained",
    ).execute()  # fmt: skip
    return place


@pytest.mark.parametrize(("make", "error", "fragments"), TABLE)
def test_each_mistake_ends_in_one_clear_error_and_loses_nothing(
    make, error, fragments, stored, tmp_path, monkeypatch, nothing_stays_behind
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(stored, "sessions")
    before = content("kept") | content("trained")
    began = time.monotonic()
    with pytest.raises(PhysxError) as caught, warnings.catch_warnings():
        warnings.simplefilter("error")
        make()
    assert time.monotonic() - began < 30
    assert type(caught.value) is error
    message = "\n".join([str(caught.value), *getattr(caught.value, "__notes__", [])])
    for fragment in fragments:
        assert fragment in message
    assert len(message) < 2000 and "Traceback" not in message
    assert content("kept") | content("trained") == before
    for folder in Path("sessions").iterdir():
        if (folder / "dataset").is_dir():
            with Dataset.open(folder) as dataset:
                assert dataset.verify() == []


# Environments -------------------------------------------------------------------------------------


class Good(Environment):
    """A point that moves at random, and how the mistakes below change it."""

    data = staticmethod(lambda data, step: data)

    def create(self):
        self.x = np.zeros(2)

    def init_database(self):
        self.define_training_fields([("state", np.ndarray), ("next_state", np.ndarray)])

    def step(self):
        before, self.x = self.x, self.x + self.rng.standard_normal(2)
        given = self.data({"state": before, "next_state": self.x}, self.step_index)
        if given is not None:
            self.set_training_data(**given)


def generate(environment=Good, batch_nb=2, batch_size=4, mode=None, session_name="new", **options):
    own = {"session_dir", "new_session", "dataset_config"} & options.keys()
    pipeline = {name: options.pop(name) for name in own}
    config = EnvironmentConfig(environment, **{"as_tcp_ip_client": False, **options})
    DataGeneration(
        config, batch_nb=batch_nb, batch_size=batch_size, mode=mode, session_name=session_name,
        **pipeline,
    ).execute()  # fmt: skip


def with_data(change, **members):
    """Generate with data that are changed: a function of the data and the step."""
    generate(type("Changed", (Good,), {"data": staticmethod(change), **members}))


def with_step(step, **members):
    """Generate with another step, which may call the usual one with ``Good.step(self)``."""
    generate(type("Changed", (Good,), {"step": step, **members}))


@mistake(e.UnknownFieldError, "Instance 1, step 0", '"nxt_state"', 'Did you mean "next_state"')
def misspells_a_field():
    with_data(lambda data, step: {"state": data["state"], "nxt_state": 1})


@mistake(e.MissingFieldError, '"next_state" is missing', "Instance 1, step 5")
def leaves_a_field_out_later():
    with_data(lambda data, step: data if step < 5 else {"state": data["state"]})


@mistake(e.MissingFieldError, "step() did not set any data: call set_training_data()")
def never_sets_data():
    with_data(lambda data, step: None)


@mistake(e.MissingFieldError, "Instance 1, step 5", "call set_training_data() in every step")
def forgets_the_data_of_a_later_step():
    with_data(lambda data, step: data if step < 5 else None)


@mistake(e.MissingFieldError, "call set_training_data()")
def writes_a_generator_in_place_of_a_step():
    def step(self):
        self.set_training_data(state=0, next_state=0)
        yield

    with_step(step)


@mistake(e.FieldShapeError, "Instance 1, step 5", '"state"', "(3,)", "(2,)")
def changes_a_shape():
    with_data(lambda data, step: data if step < 5 else data | {"state": np.zeros(3)})


@mistake(e.FieldShapeError, '"state" is ragged', "Instance 1, step 0")
def gives_a_ragged_list():
    with_data(lambda data, step: data | {"state": [[1, 2], [3]]})


@mistake(e.NotFiniteError, '"state"', "NaN", "Instance 1, step 5")
def gives_nan():
    with_data(lambda data, step: data | {"state": np.full(2, np.nan if step == 5 else 0)})


@mistake(e.NotFiniteError, '"next_state"', "Instance 1, step 1")
def gives_infinity():
    with_data(lambda data, step: data | {"next_state": np.full(2, np.inf if step == 1 else 0)})


@mistake(e.FieldTypeError, '"state"', "Instance 1, step 0")
def gives_a_text():
    with_data(lambda data, step: data | {"state": "here"})


@mistake(e.MissingFieldError, '"note" is missing')
def defines_additional_data_and_never_sets_them():
    def init_database(self):
        Good.init_database(self)
        self.define_additional_fields(("note", np.ndarray))

    with_data(lambda data, step: data, init_database=init_database)


@mistake(e.UsageError, "Changed does not implement create()")
def has_no_create():
    with_data(None, create=Environment.create)


@mistake(e.EnvironmentFailedError, "no attribute 'place'. reset_parameters() is called later")
def draws_what_only_an_episode_sets():
    class Placed(Good):
        independent_episodes = True
        create = Environment.create

        def init_visualization(self):
            self.factory.add_sphere("ball", position=self.place)

        def reset_parameters(self):
            self.place = np.zeros(3)

    config = EnvironmentConfig(Placed, as_tcp_ip_client=False, visualizer=Visualizer)
    DataGeneration(config, episodes=2, session_name="new").execute()


@mistake(e.UsageError, "Changed does not implement init_database()", 'Did you mean "init_databse"')
def misspells_init_database():
    with_data(None, init_database=Environment.init_database, init_databse=Good.init_database)


@mistake(e.UsageError, "Changed does not implement step()")
def has_no_step():
    with_step(Environment.step)


@mistake(e.UsageError, "init_database() defined no training fields", "define_training_fields()")
def defines_no_fields():
    with_data(None, init_database=lambda self: None)


@mistake(e.ConfigError, '"state" is defined twice')
def defines_a_field_twice():
    def init_database(self):
        self.define_training_fields([("state", np.ndarray), ("state", np.ndarray)])

    with_data(None, init_database=init_database)


@mistake(e.ConfigError, '"step"', "reserved")
def takes_a_name_that_physx_uses():
    with_data(None, init_database=lambda self: self.define_training_fields(("step", np.ndarray)))


@mistake(e.ConfigError, "Python identifier", "'my state'")
def names_a_field_with_a_space():
    with_data(None, init_database=lambda self: self.define_training_fields(("my state", float)))


@mistake(e.ConfigError, 'Field "name"')
def defines_a_field_of_texts():
    with_data(None, init_database=lambda self: self.define_training_fields(("name", str)))


@mistake(e.WrongSamplesError, "check_sample() rejected 11 samples in a row", "Instance 1, step 10")
def rejects_every_sample():
    with_data(lambda data, step: data, check_sample=lambda self: False)


@mistake(e.UsageError, "check_sample() returned None", "True or False")
def forgets_to_return_from_check_sample():
    with_data(lambda data, step: data, check_sample=lambda self: None)


@mistake(e.UsageError, "get_prediction() needs a network, but this run has none")
def asks_for_a_prediction_in_a_generation():
    with_step(lambda self: self.get_prediction(state=self.x))


@mistake(e.EnvironmentFailedError, "create()", "the mesh is missing")
def fails_in_create():
    with_data(None, create=lambda self: (_ for _ in ()).throw(OSError("the mesh is missing")))


@mistake(e.EnvironmentFailedError, "Instance 1 raised in step() at step 3", "the solver diverged")
def fails_in_a_step():
    generate(f"{PROGRAM}:Raises")


@mistake(e.EnvironmentFailedError, "Instance 1 raised in step() at step 3", "the solver diverged")
def fails_in_a_client():
    generate(f"{PROGRAM}:Raises", as_tcp_ip_client=True)


@mistake(e.ClientError, "Client 1", "exit status 7")
def exits_in_a_client():
    generate(f"{PROGRAM}:Exits", as_tcp_ip_client=True)


@mistake(e.ClientError, "Client 1 sent nothing for 4 s", "mistaken_envs.py")
def hangs_in_a_client():
    generate(f"{PROGRAM}:Hangs", as_tcp_ip_client=True, timeout=4.0)


@mistake(e.UsageError, "is defined inside a function", "as_tcp_ip_client=False")
def runs_a_local_class_in_clients():
    class Local(Good):
        pass

    generate(Local, as_tcp_ip_client=True)


@mistake(e.UnknownOptionError, '"stifness"', 'Did you mean "stiffness"')
def misspells_an_option_of_the_environment():
    generate("toy/spring", env_kwargs={"stifness": 1.0})


@mistake(e.UsageError, "OldConstructor.__init__() does not take seed", "super().__init__(**kwargs)")
def keeps_the_constructor_of_the_earlier_system():
    generate(f"{PROGRAM}:OldConstructor")


@mistake(e.UsageError, "OldConstructor.__init__() does not take seed", "must take **kwargs")
def keeps_it_in_clients():
    generate(f"{PROGRAM}:OldConstructor", as_tcp_ip_client=True)


@mistake(e.UsageError, "Changed.__init__() does not take instance_id, instance_nb, seed")
def takes_no_arguments():
    with_data(None, __init__=lambda self: Good.__init__(self))


@mistake(e.UnknownOptionError, 'Changed has no option "lenght"', 'Did you mean "length"')
def misspells_an_option_without_kwargs():
    def init(self, length=1, instance_id=1, instance_nb=1, seed=None):
        Good.__init__(self, instance_id=instance_id, instance_nb=instance_nb, seed=seed)

    generate(type("Changed", (Good,), {"__init__": init}), env_kwargs={"lenght": 2})


@mistake(e.UsageError, "must pass instance_id, instance_nb and seed to super().__init__()")
def does_not_hand_on_its_arguments():
    with_data(None, __init__=lambda self, **kwargs: Good.__init__(self))


@mistake(e.UsageError, "ForgetsSuper.__init__() must call super().__init__(**kwargs)")
def forgets_super():
    generate(f"{PROGRAM}:ForgetsSuper")


@mistake(e.UsageError, "ForgetsSuper.__init__() must call super().__init__(**kwargs)")
def forgets_super_in_a_client():
    generate(f"{PROGRAM}:ForgetsSuper", as_tcp_ip_client=True)


@mistake(e.EnvironmentFailedError, "'rng'", "must first call super().__init__(**kwargs)")
def uses_what_super_would_have_set():
    with_data(None, __init__=lambda self, **kwargs: self.rng.uniform())


@mistake(e.EnvironmentFailedError, "update_visualisation", 'Did you mean "update_visualization"')
def calls_a_method_by_its_british_name():
    with_step(lambda self: self.update_visualisation())


@mistake(e.EnvironmentFailedError, "sample_training", "Use sample instead.")
def reads_the_sample_by_its_former_name():
    with_step(lambda self: self.sample_training)


@mistake(e.EnvironmentFailedError, "define_training_data", "define_training_fields()")
def calls_a_method_by_the_name_in_the_manual():
    with_data(None, init_database=lambda self: self.define_training_data([("x", float)]))


@mistake(e.EnvironmentFailedError, "add_point", 'Did you mean "add_points"')
def misspells_a_method_of_the_factory():
    with_step(lambda self: self.factory.add_point("cloud", np.zeros((1, 3))))


class Seen(Visualizer):
    """Shows nothing; the environment draws."""


def drawn(draw):
    generate(type("Drawn", (Good,), {"init_visualization": draw}), visualizer=Seen)


@mistake(e.ConfigError, 'Object "cloud": positions has shape (3,), expected (n, 3)')
def draws_a_single_point_as_points():
    drawn(lambda self: self.factory.add_points("cloud", [0, 0, 0]))


@mistake(e.ConfigError, 'object "clod" does not exist. Objects: cloud')
def changes_an_object_that_was_not_added():
    def draw(self):
        self.factory.add_points("cloud", np.zeros((1, 3)))
        self.factory.update_points("clod", positions=np.zeros((1, 3)))

    drawn(draw)


@mistake(e.UnknownOptionError, '"colour"', 'Did you mean "color"')
def misspells_an_option_of_an_object():
    drawn(lambda self: self.factory.add_points("cloud", np.zeros((1, 3)), colour="red"))


@mistake(e.ReferenceFormError, "Counter", "standard library")
def gives_a_class_of_python():
    generate("collections:Counter")


@mistake(e.ReferenceFormError, "Point")
def gives_a_class_that_is_no_environment():
    generate(f"{PROGRAM}:Point")


@mistake(e.ReferenceFormError, "Linear")
def gives_a_network_for_an_environment():
    generate(Linear)


@mistake(e.ReferenceFormError, "Good")
def gives_an_environment_for_a_network():
    train(NetworkConfig(Good))


@mistake(e.ConfigError, "instance of Good", "give the class, Good, not an instance")
def gives_an_instance_of_the_environment():
    EnvironmentConfig(Good())


@mistake(e.PluginNotFoundError, '"toi"', 'Did you mean "toy"')
def misspells_a_plugin():
    generate("toi/spring")


@mistake(e.PluginNotFoundError, '"spring"', 'Did you mean "toy/spring"')
def leaves_out_the_plugin():
    generate("spring")


@mistake(e.PluginNotFoundError, '"vedo"', "of kind visualizer: ", "rerun")
def wants_a_viewer_that_nobody_has():
    generate(visualizer="vedo")


@mistake(e.ReferenceFormError, "mistaken_envs.py:Good", "names a script")
def names_a_script_without_a_class():
    generate(str(PROGRAM))


@mistake(e.ReferenceFormError, '"none.py:Class"')
def names_a_script_that_is_not_there_without_a_class():
    generate("none.py")


@mistake(e.ComponentNotFoundError, '"Sprng"', 'Did you mean "spring"')
def misspells_a_component():
    generate("toy/Sprng")


@mistake(e.ComponentNotFoundError, "nowhere.py")
def names_a_script_that_does_not_exist():
    generate("nowhere.py:Good")


# Configurations -----------------------------------------------------------------------------------


@mistake(e.ConfigError, "DataGeneration", "batch_nb")
def leaves_out_the_number_of_batches():
    DataGeneration(EnvironmentConfig(Good), batch_size=4)


@mistake(e.ConfigError, "DataGeneration.batch_size is 0 but must be at least 1")
def wants_batches_of_nothing():
    generate(batch_size=0)


@mistake(e.UnknownOptionError, '"num_client"', 'Did you mean "num_clients"')
def misspells_an_option_of_a_configuration():
    EnvironmentConfig(Good, num_client=2)


@mistake(e.ConfigError, "Replay.dataset_config is EnvironmentConfig(...), not DatasetConfig(...)")
def gives_configurations_in_another_order():
    Replay(EnvironmentConfig(Good), KEPT)


@mistake(e.ConfigError, "load_samples", "Training, Prediction and Replay")
def generates_from_stored_samples():
    generate(load_samples=True)


@mistake(e.ConfigError, "existing_dir cannot be set", "new_session=False")
def generates_into_an_existing_dataset():
    generate(dataset_config=KEPT)


@mistake(e.FieldsMismatchError, "force")
def adds_other_fields_to_a_session():
    generate("toy/spring", session_name="kept", new_session=False)


@mistake(e.ConfigError, "port", "in use")
def takes_a_port_that_is_taken():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        generate(f"{PROGRAM}:Good", as_tcp_ip_client=True, port=taken.getsockname()[1])


@mistake(e.ConfigError, "PHYSX_TOKEN")
def opens_to_other_machines_without_a_token():
    generate(
        f"{PROGRAM}:Good", as_tcp_ip_client=True, ip_address="0.0.0.0", launcher="physx/manual"
    )


# Trainings ----------------------------------------------------------------------------------------


def train(network=LINEAR, data=KEPT, environment=None, **options):
    options = {"epoch_nb": 1, "batch_size": 4, "session_name": "new", **options}
    training = Training(network, data, environment, **options)
    training.execute()
    return training


def train_online(environment, network=LINEAR, data=None, **options):
    config = {"as_tcp_ip_client": False, **options}
    train(network, data, EnvironmentConfig(environment, **config), batch_nb=4)


def of(network, **options):
    return NetworkConfig(network, **options)


@mistake(e.DatasetNotFoundError, "sessions/kepd", 'Did you mean "kept"', "contains: ")
def misspells_the_dataset():
    train(data=DatasetConfig(existing_dir="sessions/kepd"))


@mistake(e.DatasetNotFoundError, "sesions does not exist", 'Did you mean "sessions"')
def misspells_the_folder_of_the_dataset():
    train(data=DatasetConfig(existing_dir="sesions/kept"))


@mistake(e.DatasetError, 'no samples of mode "validation"', "It has: training")
def trains_on_a_mode_without_samples():
    train(data=DatasetConfig(existing_dir="sessions/kept", mode="validation"))


@mistake(e.DatasetNotFoundError, "DatasetConfig.existing_dir, or an environment that generates")
def trains_on_nothing():
    train(data=None)


@mistake(e.ConfigError, "NetworkConfig.network is missing")
def names_no_network():
    train(NetworkConfig())


@mistake(e.ConfigError, "batch_nb is missing")
def generates_for_a_training_without_a_number_of_batches():
    train(LINEAR, None, EnvironmentConfig(Good, as_tcp_ip_client=False))


@mistake(e.FieldsMismatchError, "nxt_state", "missing; there are")
def trains_on_a_field_that_is_not_stored():
    train(of("toy/linear", network_kwargs={"opt_fields": "nxt_state"}))


@mistake(e.ConfigError, "instance of Linear", "give the class, Linear, not an instance")
def gives_an_instance_of_the_network():
    NetworkConfig(Linear())


class OwnNetwork(Network):
    """A linear network in NumPy, with what a user has to write."""

    net_fields, opt_fields, pred_fields = ["state"], ["next_state"], ["prediction"]
    default_optimization = "test:unknown"

    def __init__(self):
        self.weights = np.zeros((2, 2))

    def predict(self, data):
        return {"prediction": data["state"] @ self.weights}

    def get_parameters(self):
        return {"weights": self.weights}


class OwnOptimization(Optimization):
    """Gradient descent on the mean square, in NumPy."""

    def compute_loss(self, batch):
        self.difference = batch.prediction["prediction"] - batch.targets["next_state"]
        self.inputs = batch.data["state"]
        return float(np.mean(self.difference**2))

    def optimize(self, loss):
        self.network.weights -= 1e-3 * self.inputs.T @ self.difference


def own(network=OwnNetwork, optimization=OwnOptimization, **members):
    """Train with own classes, the network's members changed."""
    changed = type("Changed", (network,), members)
    train(of(changed, optimization=optimization))


def test_an_own_network_and_optimization_in_numpy_train_resume_and_predict(
    stored, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(stored, "sessions")
    config = of(OwnNetwork, optimization=OwnOptimization)
    losses = [train(config).training_loss]
    again = {"resume": True, "epoch_nb": 5}
    losses.append(train(config, **again).training_loss)
    assert losses[1] < losses[0]
    spring = EnvironmentConfig(Good, as_tcp_ip_client=False)
    prediction = Prediction(of(OwnNetwork), spring, session_name="new", step_nb=2)
    prediction.execute()
    assert prediction.prediction["prediction"].shape == (1, 2)


@mistake(e.ConfigError, "The network Partial is not complete. It lacks: get_param", "predict()")
def writes_a_network_without_its_methods():
    train(of(type("Partial", (Network,), {})))


@mistake(e.ConfigError, "The optimization Partial is not complete. It lacks: compute_loss(), optim")
def writes_an_optimization_without_its_methods():
    own(optimization=type("Partial", (Optimization,), {}))


@mistake(e.ConfigError, "Changed names no default_optimization", "NetworkConfig.optimization")
def writes_a_network_that_nothing_trains():
    own(optimization=None, default_optimization="")


@mistake(e.ConfigError, "Changed.net_fields is 'state' but must be a list of names")
def gives_fields_as_a_text():
    own(net_fields="state")


@mistake(e.CheckpointError, "Changed.save_parameters() does not write", "It writes: weights.npz")
def writes_the_parameters_to_another_file():
    def save_parameters(self, path):
        np.savez(path.with_name("weights.npz"), weights=self.weights)

    own(save_parameters=save_parameters)


@mistake(e.CheckpointError, "Changed.save_parameters() fails", "KeyError")
def fails_to_save_the_parameters():
    own(save_parameters=lambda self, path: {}["weights"])


@mistake(e.ConfigError, "The network Changed raised in __init__(): ZeroDivisionError")
def fails_in_the_constructor_of_a_network():
    own(__init__=lambda self: 1 / 0)


@mistake(e.UnknownOptionError, 'has no option "size"')
def gives_a_network_an_unknown_option():
    train(of(OwnNetwork, network_kwargs={"size": 2}, optimization=OwnOptimization))


@mistake(e.ConfigError, "The transformation Needy needs mean: give it in transformation_kwargs")
def gives_a_transformation_too_few_arguments():
    class Needy(Transformation):
        def __init__(self, mean):
            super().__init__()

    train(of("toy/linear", transformation=Needy))


@mistake(e.ConfigError, "The network Changed has predict() where physx calls predict(data)")
def defines_predict_without_its_argument():
    own(predict=lambda self: {})


@mistake(e.UsageError, "Changed.predict() must return a dictionary with prediction, not ndarray")
def predicts_an_array():
    own(predict=lambda self, data: data["state"])


@mistake(e.UsageError, "Changed.predict() must return a dictionary with prediction, not other")
def predicts_another_field():
    own(predict=lambda self, data: {"other": data["state"]})


@mistake(e.UsageError, "Changed.predict() must return a dictionary with prediction, not NoneType")
def forgets_to_return_the_prediction():
    own(predict=lambda self, data: None)


@mistake(e.FieldsMismatchError, 'prediction: shape (4, 1), but "next_state" has (4, 2)')
def predicts_one_column_that_would_be_broadcast():
    own(predict=lambda self, data: {"prediction": data["state"][:, :1]})


@mistake(e.FieldsMismatchError, 'prediction: a list, but "next_state" has the shape (4, 2)')
def predicts_a_list():
    own(predict=lambda self, data: {"prediction": data["state"].tolist()})


@mistake(e.UsageError, 'transform_loss() must return a dictionary with "loss", not float')
def returns_a_number_from_transform_loss():
    class Own(LeastSquares):
        def transform_loss(self, loss, batch):
            return loss

    train(of("toy/linear", optimization=Own))


@mistake(e.UsageError, 'transform_loss() returned "each", which is not a number')
def returns_an_array_from_transform_loss():
    class Own(LeastSquares):
        def transform_loss(self, loss, batch):
            return {"loss": loss, "each": np.zeros(3)}

    train(of("toy/linear", optimization=Own))


def train_without(method):
    own = type("Own", (Training,), {method: lambda self: None})
    own(LINEAR, KEPT, epoch_nb=1, batch_size=4, session_name="new").execute()


@mistake(e.UsageError, "Own.batch_produce() set no batch: call super().batch_produce(), or set")
def replaces_batch_produce_without_a_batch():
    train_without("batch_produce")


@mistake(e.UsageError, "Own.optimize() set no losses: call super().optimize(), or set self.losses")
def replaces_optimize_without_losses():
    train_without("optimize")


@mistake(e.UsageError, "Own.batch_count() did not advance batch_id: call super().batch_count()")
def replaces_batch_count_without_counting():
    train_without("batch_count")


@mistake(e.UsageError, "Own.epoch_count() did not advance epoch_id", "new/network/network_0")
def replaces_epoch_count_without_counting():
    train_without("epoch_count")


@mistake(
    e.DivergedError, "Epoch 1, batch 2: the loss is inf", "learning rate", "new/network/network_0"
)
def trains_with_a_learning_rate_that_is_too_large():
    class Steep(OwnOptimization):
        def optimize(self, loss):
            self.network.weights = np.full((2, 2), 1e200)

    with np.errstate(all="ignore"):
        own(optimization=Steep)


@mistake(e.EnvironmentFailedError, "at step 11", "new/network/network_0", "resume=True")
def fails_in_an_environment_while_a_network_trains():
    def step(self):
        if self.step_index == 11:
            raise ZeroDivisionError
        Good.step(self)

    train_online(type("Changed", (Good,), {"step": step}))


@mistake(e.ConfigError, "cannot be resumed while environments generate", "num_clients was 1")
def resumes_with_other_environments():
    class Interrupted(Training):
        def batch_end(self):
            raise e.UsageError

    config = EnvironmentConfig(Good, as_tcp_ip_client=False)
    options = {"epoch_nb": 1, "batch_nb": 2, "batch_size": 4, "session_name": "new"}
    with pytest.raises(e.UsageError):
        Interrupted(LINEAR, None, config, **options).execute()
    config = dataclasses.replace(config, num_clients=2)
    Training(LINEAR, None, config, **options, resume=True).execute()


# Stored samples -----------------------------------------------------------------------------------

IGNORED = "IgnoresSample never reads Environment.sample"


@mistake(e.UsageError, IGNORED, "self.sample (field name to array)")
def replays_with_an_environment_that_ignores_samples():
    config = EnvironmentConfig(f"{PROGRAM}:IgnoresSample", as_tcp_ip_client=False)
    Replay(KEPT, config).execute()


@mistake(e.UsageError, IGNORED)
def trains_on_samples_that_the_environment_ignores():
    train_online(f"{PROGRAM}:IgnoresSample", data=KEPT, load_samples=True)


@mistake(e.UsageError, IGNORED)
def trains_on_samples_that_a_client_ignores():
    train_online(f"{PROGRAM}:IgnoresSample", data=KEPT, load_samples=True, as_tcp_ip_client=True)


@mistake(e.UsageError, IGNORED)
def predicts_for_samples_that_the_environment_ignores():
    predict(f"{PROGRAM}:IgnoresSample", data=KEPT, load_samples=True)


# Predictions --------------------------------------------------------------------------------------


def predict(environment=Good, network=None, data=None, **options):
    config = EnvironmentConfig(environment, **{"as_tcp_ip_client": False, **options})
    Prediction(
        network or NetworkConfig(), config, data, session_name="trained", step_nb=3
    ).execute()


@mistake(e.CheckpointError, "There is no network in ", "physx train")
def predicts_with_a_session_that_trained_nothing():
    Prediction(NetworkConfig(), EnvironmentConfig(Good), session_name="kept").execute()


@mistake(e.CheckpointError, '"network_7"', "Available: network_0")
def wants_a_checkpoint_that_does_not_exist():
    predict(network=NetworkConfig(which_network=7))


@mistake(e.CheckpointError, 'traind does not exist. Did you mean "trained"')
def evaluates_a_session_that_does_not_exist():
    evaluate("sessions/traind")


@mistake(
    e.CheckpointError, "There is no network in sessions:", "contains: kept, trained, trained_1"
)
def evaluates_the_folder_of_all_sessions():
    Path("sessions/trained_1").mkdir()
    evaluate("sessions")


@mistake(e.SessionError, 'traind does not exist. Did you mean "trained"')
def reads_losses_of_a_session_that_does_not_exist():
    read_scalars("sessions/traind")


@mistake(e.SessionError, "traind")
def predicts_with_a_session_that_does_not_exist():
    Prediction(NetworkConfig(), EnvironmentConfig(Good), session_name="traind").execute()


@mistake(e.MissingFieldError, 'he network does not predict "displacement"', "next_state")
def reads_a_prediction_by_another_name():
    def apply_prediction(self, prediction):
        self.x = prediction["displacement"]

    predict(type("Changed", (Good,), {"apply_prediction": apply_prediction}))


@mistake(e.FieldShapeError, "Instance 1, step 0", 'field "state" has shape (3,)', "takes (2,)")
def asks_with_another_shape():
    predict(f"{PROGRAM}:AsksWithAnotherShape")


@mistake(e.FieldShapeError, "Instance", "step 0", 'field "state" has shape (3,)', "takes (2,)")
def asks_with_another_shape_in_clients():
    predict(f"{PROGRAM}:AsksWithAnotherShape", as_tcp_ip_client=True, num_clients=2)


@mistake(e.MissingFieldError, 'he network reads the field "state"', "Given: inputs")
def asks_with_another_field():
    predict(type("Changed", (Good,), {"step": lambda self: self.get_prediction(inputs=1.0)}))


@mistake(e.NotFiniteError, "Instance 1, step 0", 'got the field "state" with NaN')
def asks_with_nan():
    predict(f"{PROGRAM}:AsksWithNan")


@mistake(e.NotFiniteError, "Instance 1, step 0", 'the network\'s prediction "next_state" holds NaN')
def predicts_with_a_network_that_answers_nan():
    class Broken(Linear):
        def predict(self, data):
            return {name: array * np.nan for name, array in super().predict(data).items()}

    predict(network=of(Broken))


@mistake(e.NotFiniteError, "Instance 1, step 0", 'the network\'s prediction "next_state" holds NaN')
def asks_a_network_that_answers_nan():
    class Broken(Linear):
        def predict(self, data):
            return {name: array * np.nan for name, array in super().predict(data).items()}

    def step(self):
        Good.step(self)
        self.get_prediction()

    predict(type("Changed", (Good,), {"step": step}), network=of(Broken))


@mistake(e.UsageError, "Before the first batch, get_prediction()", "training and additional data")
def asks_in_a_training_before_anything_is_known():
    train_online(type("Changed", (Good,), {"step": lambda self: self.get_prediction(state=self.x)}))


# PyTorch ------------------------------------------------------------------------------------------

FC = {"layers": [2, 8, 2], "net_fields": "state", "opt_fields": "next_state"}
ADAM = {"loss": "MSELoss", "optimizer": "Adam", "lr": 1e-3}


def fc(layers=FC["layers"], **options):
    return of("torch/fc", network_kwargs={**FC, "layers": layers}, **{**ADAM, **options})


@mistake(e.ComponentNotFoundError, '"FC"', 'Did you mean "fc"')
def writes_a_network_in_capitals():
    train(of("torch/FC", network_kwargs=FC, **ADAM))


@mistake(e.UnknownOptionError, '"dim_layers"', 'Did you mean "layers"')
def gives_the_layers_by_their_former_name():
    train(of("torch/fc", network_kwargs={"dim_layers": [2, 8, 2]}, **ADAM))


@mistake(e.ConfigError, "The network 'torch/fc' needs layers", "network_kwargs", "layers=...")
def gives_a_network_no_layers():
    train(of("torch/fc", **ADAM))


@mistake(e.FieldsMismatchError, "input: missing", "net_fields and opt_fields in network_kwargs")
def names_no_fields():
    train(of("torch/fc", network_kwargs={"layers": [2, 8, 2]}, **ADAM))


@mistake(e.FieldsMismatchError, "stat: missing; there are ", 'Did you mean "state"')
def misspells_a_field_of_the_network():
    named = {"net_fields": "stat", "opt_fields": "next_state"}
    train(of("torch/fc", network_kwargs={"layers": [2, 8, 2], **named}, **ADAM))


@mistake(e.ConfigError, "A training needs a loss", "--network.loss MSELoss")
def chooses_no_loss():
    train(fc(loss=None))


@mistake(e.ConfigError, "A training needs an optimizer", "--network.optimizer Adam")
def chooses_no_optimizer():
    train(fc(optimizer=None))


@mistake(e.ConfigError, "MSEloss", "MSELoss")
def misspells_a_loss():
    train(fc(loss="MSEloss"))


@mistake(e.ConfigError, "Adm", "Adam")
def misspells_an_optimizer():
    train(fc(optimizer="Adm"))


@mistake(e.FieldsMismatchError, "state")
def chooses_another_input_size():
    train(fc([5, 8, 2]))


@mistake(e.FieldsMismatchError, "next_state")
def chooses_another_output_size():
    train(fc([2, 8, 5]))


@mistake(e.ConfigError, "The loss has shape (4, 2) but must be a single number", "reduction")
def leaves_a_loss_unreduced():
    train(fc(optimization_kwargs={"loss_kwargs": {"reduction": "none"}}))


@mistake(e.DivergedError, "Epoch 1, batch ", "the loss is", "new/network/network_0", "--resume")
def trains_a_torch_network_with_a_learning_rate_that_is_too_large():
    train(fc(optimizer="SGD", lr=1e18), epoch_nb=4)


@mistake(e.CheckpointError, "layers.0.weight", "(4, 2)", "(8, 2)")
def continues_a_network_of_another_size():
    train(fc(), session_name="first")
    train(fc([2, 4, 2], network_dir="sessions/first"))


# Scripts and warnings -----------------------------------------------------------------------------


def test_a_script_without_a_guard_says_what_to_write(tmp_path, nothing_stays_behind):
    script = tmp_path / "unguarded.py"
    script.write_text(
        PROGRAM.read_text()
        + "\n\nfrom physx_core import DataGeneration, EnvironmentConfig\n"
        + "DataGeneration(EnvironmentConfig(Good), batch_nb=1, batch_size=2).execute()\n"
    )
    command = [sys.executable, str(script)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert 'Put the pipeline under  if __name__ == "__main__":' in done.stderr


@pytest.mark.parametrize("clients", [False, True])
def test_a_prediction_in_the_first_step_of_a_training_takes_its_shapes_from_the_step(
    clients, tmp_path, monkeypatch, nothing_stays_behind
):
    monkeypatch.chdir(tmp_path)
    train_online(f"{PROGRAM}:AsksBeforeShapesAreKnown", as_tcp_ip_client=clients)


def test_a_misspelt_optional_method_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    misspelt = type("Misspelt", (Good,), {"chek_sample": lambda self: True})
    with pytest.warns(UserWarning, match=r"Misspelt.chek_sample\(\). Did you mean check_sample"):
        generate(misspelt)


def test_the_table_has_seventy_rows():
    assert len(TABLE) >= 70
