"""Configurations: frozen, validated dataclasses, loaded from and saved to one TOML file.

Plugins use `options` and `at_least` to validate their components' options in the same way.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any, Literal, TypeVar, dataclass_transform

from physx_core import cells, checks
from physx_core.errors import (
    ConfigError,
    ConfigFileError,
    PhysxError,
    UnknownOptionError,
    UsageError,
)
from physx_core.parsing import parse_toml

__all__ = [
    "MODES",
    "SETS",
    "WRONG",
    "EnvironmentConfig",
    "NetworkConfig",
    "at_least",
    "configuration",
    "configuration_in",
    "from_plain",
    "merge_arguments",
    "options",
    "read_toml",
    "reference_of",
    "set_option",
    "to_plain",
    "write_toml",
]

T = TypeVar("T")


@dataclass_transform(field_specifiers=(field,), frozen_default=True)
def configuration(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass whose constructor validates its arguments.

    Field metadata may contain ``minimum`` and ``maximum`` (numbers), ``choices`` (the allowed
    values), and ``recorded`` (False: `to_plain` omits the option). Attribute docstrings become the
    help texts of the command line.
    """
    return options(dataclass(frozen=True)(cls))


def options(cls: type[T]) -> type[T]:
    """Give a dataclass a constructor that raises `ConfigError` for unknown or invalid options."""
    construct = cls.__init__
    names = [f.name for f in dataclasses.fields(cls) if f.init]  # type: ignore[arg-type]

    @functools.wraps(construct)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        unknown = kwargs.keys() - set(names)
        if unknown and type(self).__init__ is checked:
            raise UnknownOptionError(cls.__name__, unknown, names)
        try:
            construct(self, *args, **kwargs)
        except Exception as error:
            if isinstance(error, PhysxError):
                raise
            # The class's own checks run first, and may fail on a value of another type.
            if all(hasattr(self, name) for name in names):
                _validate(self, cls)
            if not isinstance(error, TypeError):
                raise
            raise ConfigError(f"{cls.__name__}: {str(error).split('() ')[-1]}.") from error
        _validate(self, cls)

    cls.__init__ = checked  # type: ignore[method-assign]
    cls._repr_pretty_ = _show  # type: ignore[attr-defined]
    return cls


def _show(self: Any, printer: Any, cycle: bool) -> None:
    """Print the options that differ from their defaults, for notebooks."""
    shown = []
    for each in dataclasses.fields(self):
        usual = each.default
        if each.default_factory is not dataclasses.MISSING:
            usual = each.default_factory()
        value = getattr(self, each.name) if each.init else usual
        if value is usual or (type(value) is type(usual) and value == usual):
            continue
        short = reference_of(value) if isinstance(value, type) else value
        shown.append((each.name, short))
    with printer.group(4, f"{type(self).__name__}(", ")"):
        for number, (name, value) in enumerate(shown):
            if number:
                printer.text(",")
                printer.breakable()
            printer.text(f"{name}=")
            printer.pretty(value)


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


@functools.cache
def _typeguard() -> Any:
    """Import typeguard without its plugins: to find them it would read all package metadata."""
    switch = "TYPEGUARD_DISABLE_PLUGIN_AUTOLOAD"
    before = os.environ.get(switch)
    os.environ[switch] = before or "1"
    try:
        import typeguard
    finally:
        if before is None:
            del os.environ[switch]
    return typeguard


def _validate(instance: Any, cls: Any) -> None:
    checks.store_declared(f"{cls.__name__}.", instance)
    typeguard = _typeguard()
    hints = _hints(cls)
    for option in dataclasses.fields(cls):
        if not option.init:
            continue
        value = getattr(instance, option.name)
        where = f"{cls.__name__}.{option.name}"
        try:
            typeguard.check_type(value, hints[option.name])
        except typeguard.TypeCheckError as error:
            raise ConfigError(_misfit(where, value, hints[option.name], error)) from None
        if value is None:
            continue
        _check_range(where, value, option.metadata)


def _misfit(where: str, value: Any, hint: Any, error: Exception) -> str:
    """Return why a value is not valid for an option."""
    name = type(value).__name__
    if dataclasses.is_dataclass(value):
        wanted = configuration_in(hint)
        return f"{where} is {name}(...)" + (f", not {wanted.__name__}(...)." if wanted else ".")
    accepts_class = any(typing.get_origin(part) is type for part in typing.get_args(hint))
    if accepts_class and type(value).__module__ != "builtins":
        return f"{where} is an instance of {name}: give the class, {name}, not an instance."
    return f"{where} is {value!r}, which has the wrong type: {error}."


def _check_range(where: str, value: Any, metadata: Mapping[Any, Any]) -> None:
    minimum, maximum = metadata.get("minimum"), metadata.get("maximum")
    choices = metadata.get("choices")
    if minimum is not None and not isinstance(value, str) and value < minimum:
        raise ConfigError(f"{where} is {value!r} but must be at least {minimum}.")
    if maximum is not None and value > maximum:
        raise ConfigError(f"{where} is {value!r} but must be at most {maximum}.")
    if choices is not None and value not in choices:
        allowed = ", ".join(repr(choice) for choice in choices)
        raise ConfigError(f"{where} is {value!r} but must be one of {allowed}.")


def at_least(minimum: float, default: Any = dataclasses.MISSING) -> Any:
    """Return a dataclass field for a number of at least `minimum`."""
    return field(default=default, metadata={"minimum": minimum})


MODES = ("training", "validation", "prediction")
"""The modes of a dataset that samples can be generated for."""
WRONG = "wrong"
"""Mode of the samples that `check_sample` rejected."""
SETS = "parameters"
"""Mode of the chosen parameters, one row for each set."""


@configuration
class EnvironmentConfig:
    """The environment that generates the samples, and how its instances run."""

    environment: str | type[Any]
    """Reference "plugin/name", "package.module:Class" or "script.py:Class", or the class itself."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment's constructor."""
    as_tcp_ip_client: bool = True
    """Run each instance in a separate process; otherwise run all in this process."""
    num_clients: int = at_least(1, 1)
    """Number of instances, each in a client of its own. Streams give the same samples with the same
    seed and the same number of instances; independent episodes do so with any number."""
    min_clients: int | None = at_least(1, None)
    """For independent episodes: start as soon as this many clients are ready, and end the run if
    there are fewer for `timeout` seconds. None: 1 if `max_clients` is set; otherwise start with all
    clients."""
    max_clients: int | None = at_least(1, None)
    """For independent episodes: how many clients there may be, those that join a run included.
    None: `num_clients`, which the launcher starts."""
    ip_address: str = "127.0.0.1"
    """Address of the server."""
    port: int = field(default=0, metadata={"minimum": 0, "maximum": 65535})
    """Port of the server; 0: any free one."""
    independent_episodes: bool | None = None
    """Whether the environment's episodes are independent: see `Environment`; False: run it as a
    stream. None: as the environment says."""
    episode_steps: int | None = at_least(1, None)
    """Number of samples of an episode, which is then independent; 1 if each is a simulation of its
    own. None: the environment decides."""
    simulations_per_step: int = at_least(1, 1)
    """Calls of `step` per sample; `compute_training_data` is False in all but the last call."""
    max_wrong_samples_per_step: int = at_least(0, 10)
    """Number of consecutive samples that `check_sample` may reject before the run fails."""
    record_wrong_samples: bool = False
    """Also store the samples that `check_sample` rejects, in the mode "wrong", unless they are
    invalid, for example because of NaN. A prediction does so only if it records."""
    load_samples: bool = False
    """Send stored samples through the environments, available as `Environment.sample`: those of
    `DatasetConfig.existing_dir` if set, otherwise the session's own. Training uses the results and
    replaces the samples with them in the session's own copy of the dataset. Prediction only reads
    the samples, in the order of writing, repeatedly."""
    only_first_epoch: bool = True
    """For training with `load_samples`: replay the samples in the first epoch only, and read the
    results in later epochs; otherwise replay the last epoch's results in every epoch."""
    always_produce: bool = False
    """Generate new samples in every epoch of a training, not only in the first; cannot be combined
    with `load_samples`."""
    visualizer: str | type[Any] | None = None
    """Visualizer, for example "rerun"; None: the environment has no factory."""
    visualizer_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the visualizer."""
    sampler: str | type[Any] | None = None
    """Sampler of the environment's parameters, for example "physx/sobol"; None: draw them from
    their distributions."""
    sampler_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the sampler."""
    seed: int | None = None
    """Seed of all instances' random streams; None: a random seed, recorded in the session."""
    timeout: float = at_least(0.1, 60.0)
    """Longest time in s that a client may be silent while the server waits for it. In a step of an
    independent episode it is not silent unless it is stopped, or the step never lets other threads
    of Python run."""
    episode_timeout: float | None = at_least(0.1, None)
    """Longest time in s that an independent episode may take; its client is ended then, and the
    episode counts as lost. None: any time."""
    retries: int | None = at_least(0, None)
    """Number of times that an independent episode, or a stream, is given to another client after
    its client was lost, a stream also after an error; the samples are the same as without that.
    Then an episode has failed, and a stream ends the run. None: once for an episode, never for a
    stream."""
    state_every: int = at_least(0, 0)
    """Number of rows after which each stream, or an independent episode, gives a state, from which
    the next client goes on; 0: there are none, and it repeats all rows. Where an engine keeps
    memory of its last step, rows depend on this number in the last bits."""
    journal_size: float = at_least(1e-6, 1.0)
    """Largest size in GB of the journal of a stream that may go on elsewhere, in the folder for
    temporary files: all predictions and stored samples that its client was given, since the last
    state if there are states. Beyond it, the run goes on, but the instance can no longer be
    restarted."""
    launcher: str | type[Any] = "physx/subprocess"
    """Launcher of the clients: "physx/subprocess" on this machine; "physx/manual" if you start them
    with ``physx client``; or a plugin's launcher."""
    launcher_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the launcher; those of "physx/subprocess" are `python`, another
    interpreter for the clients, `env`, their environment variables, and `affinity`."""
    token_file: str | None = None
    """File with the clients' secret token, readable only by its owner; None: the environment
    variable PHYSX_TOKEN if set, otherwise a random token for clients started here."""

    @property
    def is_elastic(self) -> bool:
        """Whether the run starts without waiting for all of its clients."""
        return self.min_clients is not None or self.max_clients is not None

    @property
    def places(self) -> int:
        """How many clients there may be at a time."""
        return self.num_clients if self.max_clients is None else self.max_clients


@configuration
class NetworkConfig:
    """The network to train or to predict with, and its optimization."""

    network: str | type[Any] | None = None
    """Reference of the network; None: the checkpoint's network (prediction only)."""
    network_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the network's constructor."""
    optimization: str | type[Any] | None = None
    """Reference of the optimization; None: the network's default."""
    optimization_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the optimization's constructor."""
    transformation: str | type[Any] | None = None
    """Reference of the transformation; None: the network's default."""
    transformation_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the transformation's constructor."""
    loss: str | Callable[..., Any] | dict[str, Any] | None = None
    """Loss function: a class, or the name of one in the network's library; or a table of them by
    the name of the target, and of losses of the whole batch by any name."""
    optimizer: str | type[Any] | None = None
    """Optimizer: a class, or the name of one in the network's library."""
    optimizer_kwargs: dict[str, Any] = field(default_factory=dict)
    """Further keyword arguments of the optimizer."""
    lr: float | None = None
    """Learning rate; None: the optimizer's default."""
    scheduler: str | type[Any] | None = None
    """Learning-rate scheduler: a class, or the name of one in the network's library; None: a
    constant rate."""
    scheduler_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the scheduler."""
    scheduler_interval: str | None = field(default=None, metadata={"choices": ("epoch", "step")})
    """When the scheduler is stepped: "step", with the optimizer; "epoch", after each epoch. None:
    with the optimizer if the scheduler is known to count its steps, else after each epoch; the
    first lines of a training say which."""
    network_dir: str | Path | None = None
    """Session or network folder with the initial parameters of the training."""
    network_name: str | None = None
    """Name of the checkpoints in the session; None: "network" when writing; when reading, the only
    name that exists there."""
    which_network: int | Literal["best"] = -1
    """Number of the checkpoint to load; -1: the last; "best": the one with the smallest loss."""
    save_each_epoch: bool = False
    """Write a checkpoint after every epoch, not only at the end."""
    save_best: bool | None = None
    """Save the network with the smallest validation loss, or training loss without validation, as
    checkpoint "best". None: only with validation or `Training.patience`, because the training loss
    is usually smallest at the end."""
    data_type: str = field(default="float32", metadata={"choices": ("float32", "float64")})
    """Floating-point type of the network's computations."""
    device: str = "auto"
    """Device of the network: "cpu", "cuda", "cuda:1" ... or "auto"."""
    require_training_stuff: bool = True
    """Whether training needs `loss` and `optimizer`; False if the optimization has its own."""


def to_plain(config: Any) -> dict[str, Any]:
    """Return a configuration as TOML-compatible data, omitting options that are None."""
    return {
        name: _plain_value(f"{type(config).__name__}.{name}", getattr(config, name))
        for name in (f.name for f in dataclasses.fields(config) if _is_recorded(f))
        if getattr(config, name) is not None
    }


def _is_recorded(option: dataclasses.Field[Any]) -> bool:
    return option.init and bool(option.metadata.get("recorded", True))


def _plain_value(where: str, value: Any) -> Any:
    if isinstance(value, (type, FunctionType)):
        with contextlib.suppress(UsageError):  # a class that only this process can find
            return reference_of(value)
        return f"{value.__module__}:{value.__qualname__}"
    if dataclasses.is_dataclass(value):
        return to_plain(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {
            str(key): _plain_value(f"{where}.{key}", item)
            for key, item in value.items()
            if item is not None
        }
    if isinstance(value, (list, tuple)):
        return [_plain_value(where, item) for item in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, (bool, int, float, str)):
        return value
    raise ConfigError(f"{where} is {value!r}, which cannot be written to a TOML file.")


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
        ConfigFileError: If the file is missing, unreadable, or not valid TOML.
    """
    try:
        return parse_toml(Path(path).read_bytes())
    except FileNotFoundError:
        raise ConfigFileError(f"There is no configuration file {path}.") from None
    except ValueError as error:
        raise ConfigFileError(f"{path} is not valid TOML: {error}.") from None
    except OSError as error:
        raise ConfigFileError(f"{path} cannot be read: {error.strerror or error}.") from None


def write_toml(path: str | Path, plain: Mapping[str, Any]) -> None:
    """Write plain data as a TOML file."""
    import tomli_w

    Path(path).write_text(tomli_w.dumps(plain), encoding="utf-8")


def from_plain(make: Callable[..., T], plain: Mapping[str, Any]) -> T:
    """Create a configuration from plain data; tables become nested configurations.

    Args:
        make: A configuration, or another dataclass decorated with `options`.
        plain: Option names to values, as returned by `to_plain`.

    Raises:
        ConfigError: If an option is unknown or has an invalid value.
    """
    hints = _hints(make)
    values = {}
    for name, value in plain.items():
        nested = configuration_in(hints.get(name))
        is_table = nested is not None and isinstance(value, Mapping)
        values[name] = from_plain(nested, value) if nested and is_table else value
    return make(**values)


def set_option(where: str, tables: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set one option or argument in nested tables; all others stay.

    Args:
        where: The option as the user wrote it, for errors.
        tables: The tables, which are changed; missing ones are created.
        path: The tables' names from the outside in, then the option's.
        value: Its value.

    Raises:
        ConfigError: If the path leads through something that is not a table.
    """
    *places, name = path
    table = tables
    for place in places:
        if isinstance(table.get(place), bool):  # a switch that may also be a table
            table[place] = {}
        table = table.setdefault(place, {})
        if not isinstance(table, dict):
            raise ConfigError(f"{where} names an option in {place}, which is not a table.")
    table[name] = value


def merge_arguments(former: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments in which those given replace the former ones, in nested tables too."""
    merged = dict(former)
    for name, value in given.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merge_arguments(old, value)
        merged[name] = value
    return merged


def configuration_in(hint: Any) -> Any:
    """Return the configuration class in an annotation; None if there is none."""
    for candidate in (hint, *typing.get_args(hint)):
        if isinstance(candidate, type) and dataclasses.is_dataclass(candidate):
            return candidate
    return None


SCRIPT_PREFIX = "_physx_script_"
"""Prefix of the module names under which scripts are imported."""


def reference_of(component: Any) -> str:
    """Return the reference by which another process can find a component.

    Args:
        component: A class; or a reference, which is returned unchanged.

    Raises:
        UsageError: If the class was defined in a function or in an interactive session, where other
            processes cannot find it.
    """
    if isinstance(component, str):
        return component
    module, name = component.__module__, component.__qualname__
    if "<locals>" in name:
        raise UsageError(
            f"{name} is defined inside a function, where no other process can find it. "
            "Define it at the top level of a module, or run with as_tcp_ip_client=False."
        )
    source = sys.modules.get(module)
    file = getattr(source, "__file__", None)
    if module.startswith(SCRIPT_PREFIX) and file:
        return f"{file}:{name}"
    if module != "__main__":
        return f"{module}:{name}"
    spec = getattr(source, "__spec__", None)
    if spec is not None and spec.name:
        return f"{spec.name}:{name}"
    if not file or not Path(file).is_file():
        if cells.has_source(component):
            return cells.register(name)
        raise UsageError(
            f"{name} is defined in an interactive session, where no other process can find it. "
            "Move it to a file, or run with as_tcp_ip_client=False."
        )
    return f"{Path(file).resolve()}:{name}"
