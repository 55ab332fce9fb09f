"""Definition: what a study is made of, as its TOML file says."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from physx_cluster.sweep.parameters import Parameter, Setting, read_parameters
from physx_core import DataGeneration, Training, plugins
from physx_core.config import at_least, configuration, from_plain, read_toml
from physx_core.errors import ConfigError, ConfigFileError, PhysxError, UnknownOptionError, listed

T = TypeVar("T")

STAGES: Mapping[str, type[Any]] = {"data_generation": DataGeneration, "training": Training}
"""The pipelines that a trial may run, in this order, by the names of their tables."""
GIVEN = ("session_dir", "session_name", "new_session")
"""Options that the sweep chooses for each trial."""
_COMPONENTS = {
    "environment": ("environment", "visualizer", "sampler", "launcher"),
    "network": ("network", "optimization", "transformation"),
}


@configuration
class StudyOptions:
    """What is tried, and what is compared. All results depend on these."""

    sampler: str = "grid"
    """Chooses the settings: "grid", all combinations; "random"; or one of Optuna's, for example
    "optuna/tpe"."""
    sampler_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of Optuna's sampler."""
    trials: int | None = at_least(1, None)
    """Number of settings of each pipeline; None: all of the grid."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """Each setting is tried with each of these seeds."""
    seed: int = at_least(0, 0)
    """Seed of the sampler."""
    result: str = "loss/validation"
    """The number to compare, one that a training records each epoch."""
    epoch: str = field(default="best", metadata={"choices": ("best", "last")})
    """Which epoch's number is a trial's result."""
    goal: str = field(default="minimize", metadata={"choices": ("minimize", "maximize")})
    """Which numbers are good: small ones, or large ones."""
    pruner: str | None = None
    """One of Optuna's pruners, for example "optuna/median", which ends trials that fall behind;
    None: each trial runs to its end."""
    pruner_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the pruner."""
    batch: int = at_least(1, 4)
    """Number of settings that are chosen at once: Optuna knows the results of earlier batches
    only, so that neither the number of processes nor a kill changes what it chooses."""
    threads: int = at_least(1, 1)
    """Threads of a trial's numerical libraries. Another number changes the last bits."""


@configuration
class RunOptions:
    """How the trials are run. No result depends on these."""

    executor: str = field(default="local", metadata={"choices": ("local", "ray", "slurm")})
    """Where trials run: "local", in processes of this machine, "ray" or "slurm"."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the executor: of Ray what its tasks take, of Slurm what submitit takes."""
    parallel: int = at_least(1, 1)
    """Number of trials that run at the same time."""
    restarts: int = at_least(0, 3)
    """How many times in a row a trial may end without a result, and without having got further
    than before, until it is given up."""


@dataclass(frozen=True)
class PipelineTable:
    """A pipeline that is tried, with the parameters whose values it is tried with.

    Attributes:
        stages: Tables of the pipelines, as in a session's ``config.toml``.
        parameters: Path of an option to the values that it takes.
    """

    stages: Mapping[str, Mapping[str, Any]]
    parameters: Mapping[str, Parameter]

    def with_setting(self, setting: Setting, seed: int) -> dict[str, dict[str, Any]]:
        """Return the tables of a trial.

        Args:
            setting: Values of the parameters.
            seed: Seed of the training and of its environments, unless the tables have one.
        """
        tables: dict[str, Any] = {kind: copy.deepcopy(dict(t)) for kind, t in self.stages.items()}
        for path, value in setting.items():
            _put(tables, path, value)
        tables["training"].setdefault("seed", seed)
        for table in tables.values():
            if "environment" in table:
                table["environment"].setdefault("seed", seed)
        return tables


@dataclass(frozen=True)
class Definition:
    """A study.

    Attributes:
        name: Name of the study.
        plain: The tables of the file.
        study: What is tried and compared.
        run: How.
        pipelines: The pipelines by name.
    """

    name: str
    plain: Mapping[str, Any]
    study: StudyOptions
    run: RunOptions
    pipelines: Mapping[str, PipelineTable]

    @classmethod
    def read(
        cls, path: Path, name: str | None = None, *, builds: bool = True, **run: Any
    ) -> Definition:
        """Read and check a TOML file.

        Args:
            path: The file.
            name: Name of the study; None: that of the file.
            builds: Whether to build the pipelines with the values of the parameters, and to find
                their components, which imports the plugins.
            run: Options of the table ``[run]`` that replace those of the file.

        Raises:
            ConfigError: If an option is unknown or has an invalid value; the message names file,
                table and option.
        """
        plain = read_toml(path)
        known = ("study", "run", "parameters", "pipelines")
        _check_names(f"{path}", plain, known)
        tables = {key: _table(path, key, plain.get(key, {})) for key in known}
        study = _options(StudyOptions, f"{path}: [study]", tables["study"])
        options = _options(RunOptions, f"{path}: [run]", {**tables["run"], **run})
        common = read_parameters(f"{path}: [parameters]", tables["parameters"])
        if not tables["pipelines"]:
            raise ConfigFileError(
                f"{path} has no table [pipelines.NAME.training], which holds the options of the "
                "trainings that are tried, as a session's config.toml does in [training]."
            )
        pipelines = {
            each: _pipeline(path, each, table, common)
            for each, table in tables["pipelines"].items()
        }
        _check_study(path, study)
        made = cls(
            name or path.stem, {**plain, "run": dict(tables["run"])}, study, options, pipelines
        )
        for each, pipeline in pipelines.items() if builds else ():
            _check_settings(f"{path}: [pipelines.{each}]", pipeline, study.seeds[0])
        return made

    @property
    def columns(self) -> list[str]:
        """Names of all parameters, in the order of the file."""
        return list(dict.fromkeys(p for each in self.pipelines.values() for p in each.parameters))

    @property
    def sign(self) -> int:
        """1 if small results are good, -1 if large ones are."""
        return 1 if self.study.goal == "minimize" else -1

    def find_change(self, other: Mapping[str, Any]) -> str:
        """Return what differs in another definition's tables such that its results would; or "".

        More trials than before are no difference: the first ones stay the same.
        """
        mine, former = self._compared(self.plain), self._compared(other)
        for key in sorted(mine.keys() | former.keys()):
            if mine.get(key) != former.get(key):
                return f"{key} was {former.get(key)!r} and is {mine.get(key)!r}"
        before, now = (each.get("study", {}).get("trials") for each in (other, self.plain))
        if before != now and (now is None or before is None or now < before):
            return f"study.trials was {before!r} and is {now!r}"
        return ""

    @staticmethod
    def _compared(plain: Mapping[str, Any]) -> dict[str, Any]:
        kept = {key: value for key, value in plain.items() if key != "run"}
        return {key: v for key, v in _flat(kept) if key != "study.trials"}


def build_stage(
    kind: str, table: Mapping[str, Any], make: type[T] | None = None, **given: Any
) -> T:
    """Return the pipeline of a table.

    Args:
        kind: Name of the table.
        table: Its options.
        make: A class derived from that of the kind; None: that one.
        given: Further options.

    Raises:
        ConfigError: If an option is unknown or has an invalid value.
    """
    made: Any = make or STAGES[kind]
    names = {option.name for option in dataclasses.fields(made) if option.init}
    plain = {n if f"{n}_config" not in names else f"{n}_config": v for n, v in table.items()}
    if "environment" in table and "environment" not in table["environment"]:
        raise ConfigError(f"The table [{kind}.environment] does not name the environment.")
    built: T = from_plain(made, {**plain, **given})
    return built


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _check_names(owner: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = table.keys() - set(known)
    if unknown:
        raise UnknownOptionError(owner, unknown, known)


def _table(path: Path, key: str, table: Any) -> Mapping[str, Any]:
    if not isinstance(table, Mapping):
        raise ConfigFileError(f"{path}: {key} is {table!r} and must be a table: [{key}].")
    return table


def _options(make: type[T], where: str, table: Mapping[str, Any]) -> T:
    try:
        return from_plain(make, table)
    except UnknownOptionError as error:
        raise UnknownOptionError(where, error.unknown, error.known) from None
    except ConfigError as error:
        raise ConfigError(str(error).replace(f"{make.__name__}.", f"{where} ")) from None


def _check_study(path: Path, study: StudyOptions) -> None:
    where = f"{path}: [study]"
    if not study.seeds or len(set(study.seeds)) < len(study.seeds) or min(study.seeds) < 0:
        raise ConfigError(f"{where} seeds is {study.seeds}: give different numbers from 0.")
    if study.sampler == "grid" and study.trials is not None:
        raise ConfigError(f"{where} trials is for samplers that draw; a grid is tried completely.")
    if study.sampler != "grid" and study.trials is None:
        raise ConfigError(f"{where} trials is missing: the number of settings to draw.")
    if study.sampler_kwargs and not study.sampler.startswith("optuna/"):
        raise ConfigError(f'{where} sampler_kwargs is for Optuna\'s, not for "{study.sampler}".')
    if study.pruner_kwargs and study.pruner is None:
        raise ConfigError(f"{where} pruner_kwargs is given without a pruner.")


def _pipeline(path: Path, name: str, table: Any, common: Mapping[str, Parameter]) -> PipelineTable:
    where = f"{path}: [pipelines.{name}]"
    table = _table(path, f"pipelines.{name}", table)
    _check_names(where, table, (*STAGES, "parameters"))
    if "training" not in table:
        raise ConfigFileError(
            f"{where} has no table [pipelines.{name}.training]: trials are trainings, whose "
            f"numbers are compared. It has: {listed(table)}."
        )
    stages: dict[str, Mapping[str, Any]] = {}
    for kind in STAGES:
        if kind in table:
            stage = _table(path, f"pipelines.{name}.{kind}", table[kind])
            for option in GIVEN:
                if option in stage:
                    raise ConfigError(
                        f"{where} {kind}.{option} is chosen by the sweep: leave it out."
                    )
            stages[kind] = stage
    own = read_parameters(f"{where} parameters", table.get("parameters", {}))
    return PipelineTable(stages, {**common, **own})


def _check_settings(where: str, pipeline: PipelineTable, seed: int) -> None:
    """Build the pipelines with the values of each parameter, and find all that they name."""
    first = {name: parameter.ends()[0] for name, parameter in pipeline.parameters.items()}
    _check_setting(where, pipeline, first, seed)
    for name, parameter in pipeline.parameters.items():
        for value in parameter.ends()[1:]:
            _check_setting(
                f"{where} with {name} = {value!r}", pipeline, {**first, name: value}, seed
            )


def _check_setting(where: str, pipeline: PipelineTable, setting: Setting, seed: int) -> None:
    try:
        for kind, table in pipeline.with_setting(setting, seed).items():
            build_stage(kind, table)
            for part, names in _COMPONENTS.items():
                for name in names:
                    reference = table.get(part, {}).get(name)
                    if reference is not None:
                        plugins.find(name, reference)
    except UnknownOptionError as error:
        raise UnknownOptionError(f"{where}: {error.owner}", error.unknown, error.known) from None
    except PhysxError as error:
        raise ConfigError(f"{where}: {error}") from None


def _put(tables: dict[str, Any], path: str, value: Any) -> None:
    """Set the option of a path such as ``training.network.lr``."""
    *places, name = path.split(".")
    table = tables
    if not places or places[0] not in tables:
        raise UnknownOptionError(f"The parameter {path}", [places[0] if places else name], tables)
    for place in places:
        table = table.setdefault(place, {})
        if not isinstance(table, dict):
            raise ConfigError(
                f"The parameter {path} names an option in {place}, which is no table."
            )
    table[name] = value
