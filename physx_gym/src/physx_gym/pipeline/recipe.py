"""Pipelines from plain data: an environment and the layers on it, in code or in a file."""

from __future__ import annotations

import copy
import copyreg
import json
import re
from abc import ABCMeta
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physx_core.config import read_toml
from physx_core.errors import ConfigError, ConfigFileError
from physx_gym.blocks.block import ControllerBlock, ObserverBlock
from physx_gym.env.layers.controlled import ControlledEnv
from physx_gym.env.layers.observed import ObservedEnv
from physx_gym.pipeline.components import built, check_call, check_table, find, find_environment


@dataclass(frozen=True)
class Recipe:
    """What a pipeline is made of; see `build_pipeline`.

    Attributes:
        env_config: Table of the environment.
        layers_config: Tables of the layers, the lowest first.
        name: Name of the class.
    """

    env_config: Mapping[str, Any]
    layers_config: tuple[Mapping[str, Any], ...]
    name: str

    def environment(self, given: Mapping[str, Any]) -> Any:
        """Return the environment, with options in place of those in its table."""
        make, _ = find_environment(self.env_config["cls"])
        return make(**self.options(given))

    def options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the environment's options, some of them given."""
        make, registered = find_environment(self.env_config["cls"])
        found = {**registered, **_options("env_config", self.env_config), **given}
        check_call("env_config", make, (), found)
        return found

    def below_the_top(self, given: Mapping[str, Any]) -> Any:
        """Return the environment with all layers but the last."""
        env = self.environment(given)
        for number, layer in enumerate(self.layers_config[:-1]):
            wrapper, args, options = _layer(f"layers_config[{number}]", layer, env)
            env = wrapper(*args, **options)
        return env


class PipelineType(ABCMeta):
    """Class of the classes that `build_pipeline` returns: they are written as their recipes."""

    recipe: Recipe


def _rebuilt(recipe: Recipe) -> PipelineType:
    return _class_of(recipe)


def _written(made: PipelineType) -> Any:
    """Return how a class is pickled: by its recipe, or a subclass of one by its name."""
    if "recipe" not in vars(made):
        return made.__qualname__
    return _rebuilt, (made.recipe,)


copyreg.pickle(PipelineType, _written)


def build_pipeline(
    env_config: Mapping[str, Any],
    layers_config: Sequence[Mapping[str, Any]] = (),
    *,
    name: str | None = None,
) -> Callable[..., Any]:
    """Return a class of environments that are whole pipelines.

    Its instances are the topmost layer, or the environment if there is none. Its options are those
    of the environment; those that are given are in place of the ones in `env_config`, for that
    instance only. It can be subclassed and pickled.

    Classes are named by themselves, as ``"package.module:Class"``, or, if physx brings them, by
    their names alone. Within options, a table with a ``cls`` is a part to be made too, for example
    a reward.

    Args:
        env_config: ``{"cls": ..., "kwargs": {...}}``; ``cls`` may be an id that Gymnasium knows.
        layers_config: Layers, the lowest first: each ``{"block": {"cls": ..., "name": ...,
            "kwargs": {...}}, "wrapper": {"cls": ..., "kwargs": {...}}}``. A block may do without a
            wrapper, which is then `ObservedEnv` or `ControlledEnv`, and without a name, which is
            then that of its class; a wrapper may do without a block.
        name: Name of the class; None: that of the environment's class, with ``Pipeline``.

    Raises:
        UnknownOptionError: A table has an unknown key.
        ConfigError: A table is not complete, or a part cannot be made of it.
        ComponentNotFoundError: There is no class of a name.
    """
    check_table("env_config", env_config, ("cls", "kwargs"))
    layers = _checked(layers_config)
    made, _ = find_environment(env_config["cls"])
    if name is None:
        name = getattr(made, "__name__", "Environment") + ("Pipeline" if layers else "")
    recipe = Recipe(copy.deepcopy(dict(env_config)), copy.deepcopy(tuple(layers)), name)
    return _class_of(recipe)


def load_pipeline(path: str | Path) -> Callable[..., Any]:
    """Return the class of environments that a TOML or JSON file describes.

    The file has the tables ``env_config`` and ``layers_config`` of `build_pipeline`, and may have
    a ``name``.

    Raises:
        ConfigFileError: The file is missing, or is neither TOML nor JSON.
        UnknownOptionError: A table has an unknown key.
        ConfigError: As in `build_pipeline`.
        ComponentNotFoundError: As in `build_pipeline`.
    """
    path = Path(path)
    if path.suffix not in (".toml", ".json"):
        raise ConfigFileError(
            f"{path} is no file of a pipeline: its name must end in .toml or .json."
        )
    content = read_toml(path) if path.suffix == ".toml" else _read_json(path)
    check_table(str(path), content, ("env_config", "layers_config", "name"), "env_config")
    return build_pipeline(
        content["env_config"], content.get("layers_config", ()), name=content.get("name")
    )


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigFileError(f"There is no configuration file {path}.") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigFileError(f"{path} is not valid JSON: {error}.") from None


def _checked(layers: Any) -> Sequence[Mapping[str, Any]]:
    """Check the tables of the layers, and that the classes that they name exist."""
    if not isinstance(layers, Sequence) or isinstance(layers, str):
        raise ConfigError(f"layers_config is {layers!r} but must be a list of tables.")
    for number, layer in enumerate(layers):
        where = f"layers_config[{number}]"
        check_table(where, layer, ("block", "wrapper"), "")
        if not layer:
            raise ConfigError(f"{where} has neither a block nor a wrapper.")
        if "block" in layer:
            check_table(f"{where}.block", layer["block"], ("cls", "name", "kwargs"))
        if "wrapper" in layer:
            check_table(f"{where}.wrapper", layer["wrapper"], ("cls", "kwargs"))
        _wrapper(where, layer)
    return list(layers)


def _wrapper(where: str, layer: Mapping[str, Any]) -> Any:
    """Return the class of a layer."""
    if "wrapper" in layer:
        found = find("wrapper", layer["wrapper"]["cls"])
        if not isinstance(found, type):
            raise ConfigError(f"{where}.wrapper: {found!r} is no class.")
        return found
    block = find("block", layer["block"]["cls"])
    if isinstance(block, type) and issubclass(block, ObserverBlock):
        return ObservedEnv
    if isinstance(block, type) and issubclass(block, ControllerBlock):
        return ControlledEnv
    raise ConfigError(
        f"{where}.block: {block!r} is neither an ObserverBlock nor a ControllerBlock."
    )


def _layer(where: str, layer: Mapping[str, Any], env: Any) -> tuple[Any, list[Any], dict[str, Any]]:
    """Return the class of a layer, and the arguments with which it goes on an environment."""
    wrapper, args = _wrapper(where, layer), [env]
    if "block" in layer:
        table = layer["block"]
        block = find("block", table["cls"])
        name = table.get("name", _snake(getattr(block, "__name__", "block")))
        options = _options(f"{where}.block", table)
        check_call(f"{where}.block", block, (name, env), options)
        args.append(block(name, env, **options))
    options = _options(f"{where}.wrapper", layer.get("wrapper", {}))
    check_call(f"{where}.wrapper", wrapper, tuple(args), options)
    return wrapper, args, options


def _options(where: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options in a table as new objects, so that no two environments share them."""
    options: dict[str, Any] = built(f"{where}.kwargs", copy.deepcopy(table.get("kwargs", {})))
    return options


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def _class_of(recipe: Recipe) -> PipelineType:
    """Return the class of a pipeline: a subclass of its top, whose constructor makes the rest."""
    if recipe.layers_config:
        number = len(recipe.layers_config) - 1
        where, top = f"layers_config[{number}]", recipe.layers_config[-1]
        basis = _wrapper(where, top)

        def __init__(self: Any, **kwargs: Any) -> None:  # noqa: N807 - a constructor
            _, args, options = _layer(where, top, recipe.below_the_top(kwargs))
            basis.__init__(self, *args, **options)

    else:
        basis, _ = find_environment(recipe.env_config["cls"])
        if not isinstance(basis, type):
            raise ConfigError(f"env_config: without layers, {basis!r} must be a class.")

        def __init__(self: Any, **kwargs: Any) -> None:  # noqa: N807 - a constructor
            basis.__init__(self, **recipe.options(kwargs))  # type: ignore[misc]

    content = {
        "__init__": __init__,
        "__module__": __name__,
        "__doc__": f"Pipeline of {len(recipe.layers_config)} layers; see `build_pipeline`.",
        "recipe": recipe,
    }
    return PipelineType(recipe.name, (basis,), content)
