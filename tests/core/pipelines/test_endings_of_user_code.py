"""User code that exits, or ends otherwise without an error: a run it ends is not finished."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from physx_core import (
    DataGeneration,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Replay,
    Training,
    Transformation,
    View,
    Visualizer,
)
from physx_core.cli import main
from physx_core.errors import PhysxError, UsageError
from physx_core.toy import LeastSquares, Linear, Spring

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parents[1] / "programs" / "ending_envs.py"
sys.path.insert(0, str(PROGRAM.parent))
endings = importlib.import_module("ending_envs")
sys.path.pop(0)
HERE = [way for way in endings.WAYS if way != "os._exit(0)"]
ARGUMENTS = {"net_fields": ["state", "force"]}


def generate(environment, make=DataGeneration, **options):
    config = EnvironmentConfig(environment, as_tcp_ip_client=False, seed=1, **options)
    make(config, batch_nb=3, batch_size=2, quiet=True, session_name="run").execute()


def train(make=Training, network=Linear, data=None, environment=None, **parts):
    config = NetworkConfig(network, ARGUMENTS, **parts)
    options = {"epoch_nb": 2, "batch_nb": 2, "batch_size": 2, "seed": 1, "quiet": True}
    make(config, data, environment, **options).execute()


def train_stored(**parts):
    generate(Spring)
    train(data=DatasetConfig(existing_dir="sessions/run", view=View(folds=3, fold=0)), **parts)


def predict(own):
    train_stored()
    config = EnvironmentConfig(own, as_tcp_ip_client=False, seed=1)
    Prediction(NetworkConfig(Linear), config, step_nb=5, quiet=True).execute()


def replay(own):
    generate(Spring)
    own(DatasetConfig(existing_dir="sessions/run"), quiet=True).execute()


PLACES = {
    "create": (Spring, generate),
    "init": (Spring, generate),
    "init_database": (Spring, generate),
    "step": (Spring, generate),
    "check_sample": (Spring, generate),
    "close": (Spring, generate),
    "apply_prediction": (Spring, predict),
    "forward": (Linear, lambda own: train_stored(network=own)),
    "bind": (Linear, lambda own: train_stored(network=own)),
    "compute_loss": (LeastSquares, lambda own: train_stored(optimization=own)),
    "optimize": (LeastSquares, lambda own: train_stored(optimization=own)),
    "transform_loss": (LeastSquares, lambda own: train_stored(optimization=own)),
    "epoch_end": (LeastSquares, lambda own: train_stored(optimization=own)),
    "save_state": (LeastSquares, lambda own: train_stored(optimization=own)),
    "transform_before_loss": (Transformation, lambda own: train_stored(transformation=own)),
    "data_generation_begin": (DataGeneration, lambda own: generate(Spring, own)),
    "batch_end": (DataGeneration, lambda own: generate(Spring, own)),
    "train_begin": (Training, lambda own: train_stored(make=own)),
    "epoch_begin": (Training, lambda own: train_stored(make=own)),
    "validate": (Training, lambda own: train_stored(make=own)),
    "train_end": (Training, lambda own: train_stored(make=own)),
    "batch_condition": (Training, lambda own: train_stored(make=own)),
    "replay_end": (Replay, replay),
}


def train_stored_by(own):
    generate(Spring)
    data = DatasetConfig(existing_dir="sessions/run", view=View(folds=3, fold=0))
    train(own, data=data)


EACH = [(place, way) for place in PLACES for way in ("sys.exit(0)", "own", "StopIteration")]
EVERY = [(place, way) for place in ("step", "forward", "train_end") for way in HERE]


@pytest.mark.parametrize(("place", "way"), sorted({*EACH, *EVERY}))
def test_system_exit_of_user_code_in_process_is_an_error(place, way):
    base, run = PLACES[place]
    run = train_stored_by if base is Training else run
    with pytest.raises(BaseException) as caught:
        run(endings.ending(base, place, way))
    error = caught.value
    assert isinstance(error, KeyboardInterrupt if way == "KeyboardInterrupt" else Exception)
    if way.startswith("sys.exit"):
        assert isinstance(error, UsageError) and "but the run is not finished" in str(error)
        assert "ending_envs.py" in str(error) and "SystemExit(" in str(error)


@pytest.mark.parametrize("way", ["sys.exit(0)", "own"])
def test_system_exit_in_training_keeps_checkpoint(way):
    with pytest.raises(UsageError) as caught:
        train_stored_by(endings.ending(Training, "epoch_end", way))
    assert "network_0" in caught.value.__notes__[0]
    assert (Path("sessions/training/network/network_0")).is_dir()


@pytest.mark.parametrize("way", ["sys.exit(0)", "GeneratorExit", "own"])
def test_a_loop_of_ones_own_is_not_finished_either(way):
    config = EnvironmentConfig(endings.ending(Spring, "step", way), as_tcp_ip_client=False)
    with pytest.raises(UsageError), DataGeneration(config, batch_nb=2, batch_size=2) as pipeline:
        while pipeline.batch_condition():
            pipeline.batch_produce()
            pipeline.batch_count()


def test_what_the_users_own_block_does_is_left_alone():
    generation = DataGeneration(
        EnvironmentConfig(Spring, as_tcp_ip_client=False), batch_nb=2, batch_size=2
    )
    with pytest.raises(SystemExit), generation:
        generation.execute()
        sys.exit(0)


@pytest.mark.parametrize("way", HERE)
def test_a_visualizer_does_not_end_the_run(way):
    own = endings.ending(Visualizer, "begin", way)
    if way == "KeyboardInterrupt":  # it may be Ctrl-C
        with pytest.raises(KeyboardInterrupt):
            generate(Spring, visualizer=own)
    else:
        with pytest.warns(UserWarning, match="failed and is disabled"):
            generate(Spring, visualizer=own)


@pytest.mark.parametrize("method", ["create", "step"])
@pytest.mark.parametrize("way", endings.WAYS)
def test_system_exit_of_user_code_in_client_is_an_error(method, way, nothing_stays_behind):
    config = EnvironmentConfig(
        f"{PROGRAM}:client", {"method": method, "way": way}, num_clients=2, seed=1
    )
    with pytest.raises(PhysxError, match=r"[Cc]lient|[Ii]nstance"):
        DataGeneration(config, batch_nb=5, batch_size=4, quiet=True).execute()


@pytest.mark.parametrize("client", ["", "no-"])
@pytest.mark.parametrize("way", ["sys.exit(0)", "sys.exit()", "CancelledError", "own"])
def test_a_command_fails(client, way, capsys):
    words = ["generate", f"{PROGRAM}:client", "--batch-nb", "2", "--batch-size", "4"]
    given = ["--environment.env-kwargs", "method='step'", f"way='{way}'"]
    assert main([*words, f"--environment.{client}as-tcp-ip-client", *given]) == 1
    assert "finished" in capsys.readouterr().err or not client


def test_help_still_succeeds(capsys):
    for verb in ("generate", "check"):
        assert main([verb, "--help"]) == 0, capsys.readouterr().err
