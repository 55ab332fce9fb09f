"""Pipelines from plain data: tables, in code or a file, describe an environment and its layers."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physx_core.config import read_toml
from physx_core.errors import ConfigError, ConfigFileError
from physx_core.parsing import parse_json
from physx_gym.blocks.block import ControllerBlock, ObserverBlock
from physx_gym.env.layers.block_layers import ControlledEnv, ObservedEnv
from physx_gym.env.layers.randomized import RandomizedEnv
from physx_gym.pipeline.tables import build, check_table, find, find_environment


@dataclass(frozen=True)
class Recipe:
    """A callable that creates whole pipelines; see `build_pipeline`.

    It is plain data, so it can be pickled, and registered with Gymnasium as an entry point.

    Attributes:
        env_config: Table of the environment.
        layers_config: Tables of the layers, the lowest first.
        randomize: File of ``physx identify -o`` that each episode draws from; None: none.
    """

    env_config: Mapping[str, Any]
    layers_config: tuple[Mapping[str, Any], ...] = ()
    randomize: str | None = None

    def __call__(
        self, *, backend: Any = None, randomize: str | Path | None = None, **options: Any
    ) -> Any:
        """Return a new pipeline: the topmost layer, or the environment if there are no layers.

        Args:
            backend: Engine to use instead of the one in the tables; None: the latter.
            randomize: File to draw from instead of the one in the tables; None: the latter.
            options: Options of the environment that replace those in its table.
        """
        table, layers = copy.deepcopy((self.env_config, self.layers_config))
        maker, registered = find_environment(table["cls"])
        kwargs = {**registered, **table.get("kwargs", {})}
        if backend is not None:
            simulator = {**kwargs, **options}.get("simulator")
            if isinstance(simulator, Mapping):  # a table, which has the engine among its options
                kwargs["simulator"] = {
                    **simulator,
                    "kwargs": {**simulator.get("kwargs", {}), "backend": backend},
                }
            else:
                options["backend"] = backend
        env = build("env_config", "environment", {"cls": maker, "kwargs": kwargs}, **options)
        for number, layer in enumerate(layers):
            env = _add_layer(f"layers_config[{number}]", layer, env)
        posterior = self.randomize if randomize is None else randomize
        return env if posterior is None else RandomizedEnv(env, randomizations=posterior)


def build_pipeline(
    env_config: Mapping[str, Any],
    layers_config: Sequence[Mapping[str, Any]] = (),
    randomize: str | None = None,
) -> Recipe:
    """Return a callable that creates the pipeline described by tables.

    A class is given as the class itself, as ``"package.module:Class"``, or, if physx provides it,
    by its name alone. Within options, a table with a ``cls`` is replaced by the part that it
    describes, for example a reward.

    Args:
        env_config: ``{"cls": ..., "kwargs": {...}}``; ``cls`` may be an id registered with
            Gymnasium.
        layers_config: Layers, the lowest first: each ``{"block": {"cls": ..., "name": ...,
            "kwargs": {...}}, "wrapper": {"cls": ..., "kwargs": {...}}}``. A block without a wrapper
            gets an `ObservedEnv` or a `ControlledEnv`; one without a name is named after its class.
            A wrapper does not need a block.
        randomize: File of ``physx identify -o``: a `RandomizedEnv` on top of the layers draws from
            its posterior.

    Raises:
        UnknownOptionError: If a table has an unknown key.
        ConfigError: If a table is incomplete, or does not describe a part of its kind.
        ComponentNotFoundError: If a class is not found.
    """
    check_table("env_config", env_config, ("cls", "kwargs"))
    find_environment(env_config["cls"])
    if not isinstance(layers_config, Sequence) or isinstance(layers_config, str):
        raise ConfigError(f"layers_config is {layers_config!r} but must be a list of tables.")
    for number, layer in enumerate(layers_config):
        _check_layer(f"layers_config[{number}]", layer)
    if randomize is not None and not isinstance(randomize, str):
        raise ConfigError(f"randomize is {randomize!r} but must be the name of a file.")
    return Recipe(*copy.deepcopy((env_config, tuple(layers_config))), randomize)


def load_pipeline(path: str | Path) -> Recipe:
    """Return a callable that creates the pipeline described by a TOML or JSON file.

    The file has the tables ``env_config`` and ``layers_config`` of `build_pipeline`, and optionally
    ``randomize``, a file relative to its own folder.

    Raises:
        ConfigFileError: If the file is missing, or is neither TOML nor JSON.
        UnknownOptionError: As in `build_pipeline`.
        ConfigError: As in `build_pipeline`.
        ComponentNotFoundError: As in `build_pipeline`.
    """
    path = Path(path)
    if path.suffix not in (".toml", ".json"):
        raise ConfigFileError(
            f"{path} is not a pipeline file: its name must end in .toml or .json."
        )
    content = read_toml(path) if path.suffix == ".toml" else _read_json(path)
    check_table(str(path), content, ("env_config", "layers_config", "randomize"), "env_config")
    if isinstance(content.get("randomize"), str):
        content["randomize"] = str(path.parent / content["randomize"])
    return build_pipeline(**content)


def _read_json(path: Path) -> Any:
    try:
        return parse_json(path.read_bytes())
    except FileNotFoundError:
        raise ConfigFileError(f"There is no configuration file {path}.") from None
    except ValueError as error:
        raise ConfigFileError(f"{path} is not valid JSON: {error}.") from None


# Layers -----------------------------------------------------------------------------------------


def _check_layer(where: str, layer: Any) -> None:
    """Check the table of a layer, and that the classes it names exist."""
    check_table(where, layer, ("block", "wrapper"), "")
    if not layer:
        raise ConfigError(f"{where} has neither a block nor a wrapper.")
    if "block" in layer:
        check_table(f"{where}.block", layer["block"], ("cls", "name", "kwargs"))
    if "wrapper" in layer:
        check_table(f"{where}.wrapper", layer["wrapper"], ("cls", "kwargs"))
    _find_wrapper(where, layer)


def _find_wrapper(where: str, layer: Mapping[str, Any]) -> Any:
    """Return the class of a layer."""
    if "wrapper" in layer:
        found = find("wrapper", layer["wrapper"]["cls"])
        if not isinstance(found, type):
            raise ConfigError(f"{where}.wrapper: {found!r} is not a class.")
        return found
    block = find("block", layer["block"]["cls"])
    for kind, wrapper in ((ObserverBlock, ObservedEnv), (ControllerBlock, ControlledEnv)):
        if isinstance(block, type) and issubclass(block, kind):
            return wrapper
    raise ConfigError(
        f"{where}.block: {block!r} is neither an ObserverBlock nor a ControllerBlock."
    )


def _add_layer(where: str, layer: Mapping[str, Any], env: Any) -> Any:
    """Return a layer on an environment."""
    args = [env]
    if "block" in layer:
        table = dict(layer["block"])
        default = getattr(find("block", table["cls"]), "__name__", "block")
        name = table.pop("name", _to_snake_case(default))
        args.append(build(f"{where}.block", "block", table, name, env))
    table = {**layer.get("wrapper", {}), "cls": _find_wrapper(where, layer)}
    return build(f"{where}.wrapper", "wrapper", table, *args)


def _to_snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
