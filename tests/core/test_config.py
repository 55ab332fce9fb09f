import dataclasses

import numpy as np
import pytest

from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig
from physx_core.config import from_plain, options, read_toml, to_plain, write_toml
from physx_core.errors import ConfigError, ConfigFileError, UnknownOptionError


def test_misspelt_option_names_the_nearest():
    with pytest.raises(
        UnknownOptionError, match='no option "num_client".*Did you mean "num_clients"'
    ):
        EnvironmentConfig("toy/spring", num_client=2)
    with pytest.raises(UnknownOptionError, match="batch_nb"):
        DataGeneration(EnvironmentConfig("toy/spring"), batch_n=1, batch_size=1)


def test_missing_option_is_named():
    with pytest.raises(ConfigError, match="environment"):
        EnvironmentConfig()


@pytest.mark.parametrize(
    ("option", "value"),
    [("num_clients", 0), ("num_clients", "2"), ("port", -1), ("timeout", 0.0), ("env_kwargs", 3)],
)
def test_unfit_values_are_refused_by_name(option, value):
    with pytest.raises(ConfigError, match=f"EnvironmentConfig.{option}"):
        EnvironmentConfig("toy/spring", **{option: value})


def test_choices_are_listed():
    with pytest.raises(ConfigError, match="'training', 'validation', 'prediction'"):
        DatasetConfig(mode="test")


def test_configurations_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        DatasetConfig().shuffle = False


def test_toml_round_trip(tmp_path):
    config = EnvironmentConfig(
        "dart/arm", env_kwargs={"gains": (1.0, 2.5), "name": "é", "deep": {"a": [1]}}, seed=7
    )
    write_toml(tmp_path / "c.toml", to_plain(config))
    again = from_plain(EnvironmentConfig, read_toml(tmp_path / "c.toml"))
    assert again.env_kwargs == {"gains": [1.0, 2.5], "name": "é", "deep": {"a": [1]}}
    assert dataclasses.replace(again, env_kwargs=config.env_kwargs) == config


def test_nested_tables_become_configurations():
    plain = {"environment_config": {"environment": "toy/spring"}, "batch_nb": 2, "batch_size": 3}
    pipeline = from_plain(DataGeneration, plain)
    assert pipeline.environment_config == EnvironmentConfig("toy/spring")
    with pytest.raises(UnknownOptionError, match="environmen"):
        from_plain(DataGeneration, {**plain, "environment_config": {"environmen": "toy/spring"}})


def test_classes_and_arrays_become_text_and_lists():
    plain = to_plain(NetworkConfig("torch/fc", network_kwargs={"a": np.arange(2), "b": Exception}))
    assert plain["network_kwargs"] == {"a": [0, 1], "b": "builtins:Exception"}


def test_files_that_are_none_are_named(tmp_path):
    with pytest.raises(ConfigFileError, match="no configuration file"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("a = ")
    with pytest.raises(ConfigFileError, match="not valid TOML"):
        read_toml(tmp_path / "bad.toml")
    with pytest.raises(ConfigError, match="cannot be written"):
        to_plain(EnvironmentConfig("x", env_kwargs={"f": object()}))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"size": "12"}, r"Viewer\.size is '12' but must be"),
        ({"size": 3}, r"Viewer\.size is 3 but must be"),
        ({"name": 5}, r"Viewer\.name is 5, which has the wrong type"),
        ({"size": (1, 2)}, "too small"),
        ({"name": "loud"}, "no good name"),
    ],
)
def test_a_value_of_another_type_is_named_before_the_classes_own_checks_meet_it(given, message):
    @options
    @dataclasses.dataclass
    class Viewer:
        size: tuple[int, int] = (100, 100)
        name: str = "a"

        def __post_init__(self):
            if min(self.size) < 64:
                raise ConfigError("too small")
            if self.name.upper() == "LOUD":
                raise ValueError("no good name")

    with pytest.raises((ConfigError, ValueError), match=message):
        Viewer(**given)
