"""Descriptions store each number as the type that they declare, whatever type was given."""

from __future__ import annotations

import dataclasses
import importlib
import json
import pickle
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import public_names
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

import physx_core
import physx_identify
import physx_sim
from physx_core import (
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    checks,
)
from physx_core.config import from_plain, read_toml, to_plain, write_toml
from physx_core.dataset import EpisodeRecord
from physx_core.errors import ConfigError
from physx_formats import ExportOptions
from physx_gym import Trajectory
from physx_gym.tasks import quantities
from physx_rerun import RerunVisualizer
from physx_viser import ViserVisualizer

ENVIRONMENT = EnvironmentConfig("toy/spring")
ERRORS = {
    "noise": {"position": 0.5},
    "bias": {"position": (0.25,)},
    "bias_deviation": 0.125,
    "random_walk": {"velocity": [0.5]},
    "period": 0.25,
}
BODY = {"name": "thing", "position": (1.0, 0.5, 0.25), "orientation": (0.5, 0.1, -0.7, 0.5005)}

# Options that make an object of each class and hold a number wherever one can be.
GIVEN: dict[type[Any], dict[str, Any]] = {
    physx_sim.Box: {**BODY, "size": (1.0, 0.5, 0.25)},
    physx_sim.Sphere: {**BODY, "radius": 0.5},
    physx_sim.Capsule: {**BODY, "radius": 0.5, "length": 2.0},
    physx_sim.Cylinder: {**BODY, "radius": 0.5, "length": 2.0},
    physx_sim.Mesh: {**BODY, "path": "shape.stl"},
    physx_sim.WorldObject: BODY,
    physx_sim.Ground: {"normal": (0.1, 0.2, 0.7)},
    physx_sim.Stairs: {},
    physx_sim.HeightField: {"heights": [[0.0, 1.0], [0.5, 0.25]], "origin": (1.0, 0.5)},
    physx_identify.Unknown: {"kind": "mass", "of": "hand", "mean": 0.5, "deviation": 0.25},
    physx_sim.JointSettings: {
        **{"damping": 0.5, "friction": 0.25, "stiffness": 2.0, "rest": 0.5, "armature": 0.125}
    },
    physx_sim.Mimic: {"leader": "knee", "multiplier": -0.5, "offset": 0.25},
    physx_sim.JointCoupling: {"joints": {"knee": 0.5, "hip": -2.0}, "offset": 0.25},
    physx_sim.Weld: {"body_a": "hand", "position": (1.0, 0.5, 0.25)}
    | {"orientation": BODY["orientation"]},
    physx_sim.Connect: {"body_a": "hand", "point_a": (1.0, 0.5, 0.25), "point_b": (0.5, 2.0, 1.0)},
    physx_sim.Wheel: {"link": "wheel", "radius": 0.25, "axis": (1.0, 0.5, 0.25)},
    physx_sim.Robot: {
        "urdf": "arm.urdf",
        "feet": {"foot": 0.25},
        "mass_factors": {"link": 1.25, "hand": 0.5},
        **{"friction": 0.5, "torsional_friction": 0.25, "rolling_friction": 0.125},
    },
    physx_sim.World: {"robots": [physx_sim.Robot("arm.urdf")], "iterations": 3},
    physx_sim.Wrench: {
        "body": "hand",
        "force": [[1.0, 0.5, 2.0], [0.0, 1.0, 0.0]],
        "duration": 0.5,
        "times": (0.25, 1.0),
    },
    physx_sim.Motor: {"joint": "knee", "stiffness": 4.0, "inertia": 0.5, "period": 0.25}
    | {"max_torque": 2.0, "max_velocity": 4.0, "slope": 0.5, "viscous": (0.5, 0.25), "dry": 1.0},
    physx_sim.Encoder: {"name": "knee", "joint": "knee", **ERRORS},
    physx_sim.Imu: {"name": "imu", "body": "head", "period": 0.25},
    physx_sim.ContactSensor: {"name": "sole", "body": "foot", "period": 0.25},
    physx_sim.ForceTorqueSensor: {"name": "wrist", "joint": "wrist", "period": 0.25},
    physx_sim.Lidar: {"name": "lidar", "body": "head", "directions": [(1.0, 0.5, 0.0)]}
    | {"position": (1.0, 0.5, 0.25), "reach": 4.5, "period": 0.25},
    physx_sim.Camera: {"name": "eye", "body": "head", "reach": 4.5, "near": 0.5, "height": 8}
    | {"width": 16, "field_of_view": 0.5, "position": (1.0, 0.5, 0.25), "period": 0.25},
    physx_sim.HeightScan: {"name": "scan", "body": "head", "points": [(1.0, 0.5)], "reach": 4.5}
    | {"period": 0.25},
    physx_sim.EffortSensor: {"name": "knee", "joint": "knee", "period": 0.25},
    physx_core.Field: {"name": "q", "shape": (3, 2)},
    physx_core.Parameter: {
        "name": "load",
        "low": (0.0, 0.5),
        "high": 4.0,
        "shape": 2,
        "distribution": "normal",
        "mean": [1.0, 2.0],
        "deviation": 0.5,
    },
    EnvironmentConfig: {"environment": "toy/spring", "min_clients": 1, "max_clients": 2, "seed": 3}
    | {"episode_steps": 4, "episode_timeout": 2.5, "independent_episodes": True, "retries": 2},
    DatasetConfig: {"max_file_size": 0.25},
    physx_core.View: {"folds": 4, "fold": 1, "test_fold": 2, "fold_seed": 3, "stride": 2}
    | {"sources": {"a": 0.5}},
    EpisodeRecord: {"episode": 3, "rows": 2, "seconds": 0.5},
    physx_sim.BodySettings: {"mass": 2.5, "friction": 0.25, "hidden": True}
    | {"torsional_friction": 0.5, "rolling_friction": 0.125}
    | {"position": (0.5, 1.0, 2.0), "orientation": (0.0, 0.0, 0.0, 1.0)}
    | {"velocity": (0.5, 1.0, 2.0), "angular_velocity": (0.5, 1.0, 2.0)}
    | {"surface_velocity": (0.5, 1.0, 2.0)},
    NetworkConfig: {"lr": 0.5, "which_network": 2, "save_best": True},
    physx_core.DataGeneration: {"environment_config": ENVIRONMENT, "batch_nb": 2, "batch_size": 4},
    physx_core.Training: {"network_config": NetworkConfig(), "epoch_nb": 2, "batch_size": 4}
    | {"batch_nb": 2, "seed": 1, "patience": 2, "checkpoint_every": 5}
    | {"validation_batch_size": 8, "unroll": (1, 2), "noise": 0.5},
    physx_core.Prediction: {
        "network_config": NetworkConfig(),
        "environment_config": ENVIRONMENT,
    },
    physx_core.Replay: {
        "environment_config": ENVIRONMENT,
        "dataset_config": DatasetConfig(),
        "step_nb": 4,
    },
    physx_core.Branch: {"data": "sessions/data", "row": 3, "step_nb": 4, "past": 5},
    RerunVisualizer: {},
    ViserVisualizer: {},
    ExportOptions: {"fps": 30},
    Trajectory: {"times": [0.0, 1.0], "positions": [[1.0], [2.0]], "velocities": [[0.5], [0.0]]},
    quantities.Masked: {"quantity": quantities.JointPositions(), "entries": [2, 0]},
    quantities.Stacked: {"quantity": quantities.JointPositions(), "steps": 2},
    quantities.Delta: {"quantity": quantities.JointPositions()},
    quantities.Mean: {"quantity": quantities.JointPositions(), "steps": 3},
}
# What physx returns, and what engines hold; users do not write these.
RECORDS = {
    *(
        "Layout",
        "Part",
        "State",
        "AppliedWrench",
        "AppliedAttachment",
        "MotorState",
        "SensorState",
        "RobotInfo",
        "StepDerivatives",
        "ActuatorNetwork",
        "LearnedActuator",
        "Actuators",
    ),
    *(
        "UrdfShape",
        "VisualShape",
        "VisualModel",
        "Episode",
        "StepperState",
        "Result",
        "Comparison",
        "Trial",
        "Normalization",
    ),
    *("CollisionShape", "Joint", "MovableBody", "RigidBody", "Static", "LoadedRobot", "LoadedBody"),
    "Bond",
    *(
        "Combination",
        "Estimate",
        "EngineFit",
        "Identification",
        "Log",
        "LogNoise",
        "Motion",
        "ResidualTest",
    ),
    *("Agreement", "Cause", "Figure", "Parting", "Ranking"),
    *("Kind", "Format", "Table", "Section", "RolloutResult", "Unseen", "Score", "Cursor"),
}
ABSTRACT = {"Attachment", "Pipeline", "RaySensor", "Sensor"}

FLOATS: dict[str, Callable[[float], Any]] = {
    "float32": np.float32,
    "float64": np.float64,
    "longdouble": np.longdouble,
    "array": np.array,
    "array of float32": lambda x: np.array(x, np.float32),
    "array of object": lambda x: np.array(Fraction(x), object),
    "tensor": torch.tensor,
    "Fraction": Fraction,
    "Decimal": Decimal,
    "int": lambda x: int(x) if x.is_integer() else x,
    "int64": lambda x: np.int64(x) if x.is_integer() else x,
}
INTEGERS: dict[str, Callable[[int], Any]] = {
    "int64": np.int64,
    "int32": np.int32,
    "array": np.array,
    "tensor": torch.tensor,
}
BOOLEANS: dict[str, Callable[[bool], Any]] = {"bool": np.bool_, "array": np.array}
NOT_FLOATS = (True, np.bool_(False), "0.5", b"1", 1j, np.array("1.0"), np.timedelta64(1, "ns"))
NOT_INTEGERS = (True, np.True_, "1", 1.0, np.float64(1), Fraction(1), np.array(True))
NOT_BOOLEANS = (1, 0.0, "False", np.int64(1), np.array(1))


def declared() -> dict[type[Any], list[str]]:
    """Return the public dataclasses with numbers, except records, and the options with numbers."""
    found = {}
    for module in public_names.MODULES:
        face = importlib.import_module(module)
        for name in getattr(face, "__all__", ()):
            value = getattr(face, name)
            if dataclasses.is_dataclass(value) and name not in RECORDS | ABSTRACT:
                options = [option for option, _ in checks.conversions(value)]
                if options:
                    found[value] = options
    return found


def number_at(cls: type[Any], option: str) -> Any:
    """Return the value that an option has in these tests."""
    default = next(f for f in dataclasses.fields(cls) if f.name == option)
    value = GIVEN[cls].get(option, default.default)
    return {} if value is dataclasses.MISSING else value


def leaves(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a value with each number in it changed."""
    if isinstance(value, Mapping):
        return {key: leaves(each, change) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return type(value)(leaves(each, change) for each in value)
    return change(value) if isinstance(value, (bool, int, float)) else value


def numbers_in(value: Any) -> Iterator[Any]:
    found: list[Any] = []
    leaves(value, lambda each: found.append(each))
    yield from found


def outcome(cls: type[Any], options: dict[str, Any]) -> str:
    """Return the object's representation, or that the options are refused."""
    try:
        return repr(cls(**options))
    except ConfigError:
        return "refused"


CASES = [(cls, option) for cls in GIVEN for option, _ in checks.conversions(cls)]
CASES.remove((physx_core.DataGeneration, "episodes"))  # instead of batches
CASES += [(physx_core.Parameter, option) for option in ("low", "high", "mean", "deviation")]


@pytest.mark.slow  # imports all packages
def test_every_public_description_is_covered_with_a_number_in_each_option() -> None:
    assert declared().keys() <= GIVEN.keys(), "add options for the new description to GIVEN"
    for cls, option in CASES:
        assert list(numbers_in(number_at(cls, option))), f"{cls.__name__}.{option}"


@settings(max_examples=size(400, 50), deadline=None)
@given(
    st.sampled_from(CASES),
    st.sampled_from(sorted(FLOATS)),
    st.sampled_from(sorted(INTEGERS)),
    st.sampled_from(sorted(BOOLEANS)),
    st.sampled_from([0.25, 0.5, 1.0, 3.0]),
)
def test_numbers_of_any_type_are_stored_as_declared(
    case: tuple[type[Any], str], real: str, whole: str, flag: str, factor: float
) -> None:
    cls, option = case

    def scale(x: Any) -> Any:  # exact in each of the types
        return float(np.float32(x * factor)) if type(x) is float else x

    scaled = leaves(number_at(cls, option), scale)

    def convert(x: Any) -> Any:
        if type(x) is bool:
            return BOOLEANS[flag](x)
        return INTEGERS[whole](x) if type(x) is int else FLOATS[real](x)

    plain, foreign = ({**GIVEN[cls], option: value} for value in (scaled, leaves(scaled, convert)))
    assert outcome(cls, foreign) == outcome(cls, plain)


@settings(max_examples=size(200, 25), deadline=None)
@given(st.sampled_from(CASES), st.integers(0, 6))
def test_what_is_not_of_the_declared_kind_is_refused_by_name(
    case: tuple[type[Any], str], choice: int
) -> None:
    cls, option = case
    value = number_at(cls, option)
    kinds = {bool: NOT_BOOLEANS, int: NOT_INTEGERS, float: NOT_FLOATS}
    kind = type(next(numbers_in(value)))
    wrong = kinds[kind][choice % len(kinds[kind])]
    with pytest.raises(ConfigError) as error:
        cls(**{**GIVEN[cls], option: leaves(value, lambda _: wrong)})
    assert option in str(error.value)


@pytest.mark.parametrize("cls", GIVEN, ids=lambda cls: cls.__name__)
def test_a_description_of_numpy_numbers_survives_repr_pickle_and_json(cls: Any) -> None:
    foreign = {
        option: leaves(
            number_at(cls, option),
            lambda x: np.bool_(x) if type(x) is bool else np.array(x)[()],
        )
        for option, _ in checks.conversions(cls)
    }
    made = cls(**{**GIVEN[cls], **foreign})
    assert "np." not in repr(made)
    if cls.__dataclass_params__.frozen:
        assert repr(pickle.loads(pickle.dumps(made))) == repr(made)  # noqa: S301
    plain = {f.name: getattr(made, f.name) for f in dataclasses.fields(made) if f.init}
    again = cls(**plain)
    assert repr(again) == repr(made)
    numbers = {option: plain[option] for option, _ in checks.conversions(cls)}
    arrays = (np.ndarray,)
    lists = {k: v.tolist() if isinstance(v, arrays) else v for k, v in numbers.items()}
    read = json.loads(json.dumps(lists))
    assert repr(cls(**{**plain, **read})) == repr(made)


@pytest.mark.parametrize("cls", [EnvironmentConfig, DatasetConfig, NetworkConfig])
def test_a_configuration_of_numpy_numbers_survives_toml(cls: Any, tmp_path: Any) -> None:
    foreign = {
        option: leaves(number_at(cls, option), lambda x: np.array(x)[()])
        for option, _ in checks.conversions(cls)
    }
    made = cls(**{**GIVEN[cls], **foreign})
    write_toml(tmp_path / "config.toml", to_plain(made))
    assert from_plain(cls, read_toml(tmp_path / "config.toml")) == made
