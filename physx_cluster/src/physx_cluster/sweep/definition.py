"""Definition: the contents of a study, read from its TOML file."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from physx_cluster.sweep.parameters import Parameter, Setting, read_parameters
from physx_core import DataGeneration, Training, plugins
from physx_core.config import at_least, configuration, from_plain, read_toml, set_option
from physx_core.errors import ConfigError, ConfigFileError, PhysxError, UnknownOptionError, listed

T = TypeVar("T")

STAGES: Mapping[str, type[Any]] = {"data_generation": DataGeneration, "training": Training}
"""The pipelines that a trial may run, by the names of their tables, in the order they run."""
GIVEN = ("session_dir", "session_name", "new_session")
"""Options that the sweep sets for each trial."""
_COMPONENTS = {
    "environment": ("environment", "visualizer", "sampler", "launcher"),
    "network": ("network", "optimization", "transformation"),
}


@configuration
class StudyOptions:
    """What is tried and compared. All results depend on these."""

    sampler: str = "grid"
    """How settings are chosen: "grid", all combinations; "random"; or one of Optuna's samplers, for
    example "optuna/tpe"."""
    sampler_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of Optuna's sampler."""
    trials: int | None = at_least(1, None)
    """Number of settings per pipeline; None: the whole grid."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """Each setting is tried with each of these seeds."""
    seed: int = at_least(0, 0)
    """Seed of the sampler."""
    result: str = "loss/validation"
    """Name of the number to compare; the training must record it each epoch."""
    epoch: str = field(default="best", metadata={"choices": ("best", "last")})
    """The epoch whose number is the trial's result."""
    goal: str = field(default="minimize", metadata={"choices": ("minimize", "maximize")})
    """Whether small or large numbers are better."""
    pruner: str | None = None
    """One of Optuna's pruners, for example "optuna/median", which ends trials that fall behind;
    None: every trial runs to its end."""
    pruner_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the pruner."""
    batch: int = at_least(1, 4)
    """Number of settings chosen at once: Optuna sees only the results of earlier batches, so
    neither the number of processes nor a kill changes what it chooses."""
    threads: int = at_least(1, 1)
    """Threads of each trial's numerical libraries. Changing the number changes the last bits."""


@configuration
class RunOptions:
    """How the trials run. No result depends on these."""

    executor: str = "local"
    """Where trials run: "local", in processes on this machine, "ray", "slurm", or that of another
    plugin."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the executor: those of Ray tasks, or submitit's parameters."""
    parallel: int = at_least(1, 1)
    """Number of concurrent trials."""
    restarts: int = at_least(0, 3)
    """Number of consecutive attempts at a trial that may end without a result and without progress
    before it is given up."""


@dataclass(frozen=True)
class PipelineTable:
    """A pipeline to try, with the parameters to vary.

    Attributes:
        stages: Tables of the pipelines, as in a session's ``config.toml``.
        parameters: Path of an option to the values to try.
    """

    stages: Mapping[str, Mapping[str, Any]]
    parameters: Mapping[str, Parameter]

    def with_setting(self, setting: Setting, seed: int) -> dict[str, dict[str, Any]]:
        """Return the tables of a trial.

        Args:
            setting: Values of the parameters.
            seed: Seed of the training and of its environments, unless the tables set one.
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
        plain: The file's tables.
        study: What is tried and compared.
        run: How the trials run.
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
            name: Name of the study; None: the file's name.
            builds: Whether to build the pipelines with the parameters' values and find their
                components, which imports the plugins.
            run: Options that replace those of the file's table ``[run]``.

        Raises:
            ConfigError: If an option is unknown or has an invalid value; the message names the
                file, table and option.
        """
        plain = read_toml(path)
        known = ("study", "run", "parameters", "pipelines")
        _check_names(f"{path}", plain, known)
        tables = {key: _table(path, key, plain.get(key, {})) for key in known}
        study = _options(StudyOptions, f"{path}: [study]", tables["study"])
        options = _options(RunOptions, f"{path}: [run]", {**tables["run"], **run})
        try:
            plugins.complete_reference("trial_executor", options.executor)
        except PhysxError as error:
            raise ConfigError(f"{path}: [run] executor: {error}") from error
        common = read_parameters(f"{path}: [parameters]", tables["parameters"])
        if not tables["pipelines"]:
            raise ConfigFileError(
                f"{path} has no table [pipelines.NAME.training], which holds the options of the "
                "trainings to try, like [training] in a session's config.toml."
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
        """Names of all parameters, in the file's order."""
        return list(dict.fromkeys(p for each in self.pipelines.values() for p in each.parameters))

    @property
    def sign(self) -> int:
        """1 if small results are better, -1 if large ones are."""
        return 1 if self.study.goal == "minimize" else -1

    def find_change(self, other: Mapping[str, Any]) -> str:
        """Return a difference from another definition's tables that changes results; empty if none.

        More trials than before are not a difference: the first ones stay the same.
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
    """Return a table's pipeline.

    Args:
        kind: Name of the table.
        table: Its options.
        make: A subclass of the kind's class; None: that class.
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
        raise ConfigError(f"{where} seeds is {study.seeds}, but must list distinct numbers from 0.")
    if study.sampler == "grid" and study.trials is not None:
        raise ConfigError(f"{where} trials is for samplers that draw; a grid is always complete.")
    if study.sampler != "grid" and study.trials is None:
        raise ConfigError(f"{where} trials is missing: set the number of settings to draw.")
    if study.sampler_kwargs and not study.sampler.startswith("optuna/"):
        raise ConfigError(f'{where} sampler_kwargs is only for Optuna, not for "{study.sampler}".')
    if study.pruner_kwargs and study.pruner is None:
        raise ConfigError(f"{where} pruner_kwargs is set without a pruner.")


def _pipeline(path: Path, name: str, table: Any, common: Mapping[str, Parameter]) -> PipelineTable:
    where = f"{path}: [pipelines.{name}]"
    table = _table(path, f"pipelines.{name}", table)
    _check_names(where, table, (*STAGES, "parameters"))
    if "training" not in table:
        raise ConfigFileError(
            f"{where} has no table [pipelines.{name}.training]: trials are trainings, whose "
            f"results are compared. It has: {listed(table)}."
        )
    stages: dict[str, Mapping[str, Any]] = {}
    for kind in STAGES:
        if kind in table:
            stage = _table(path, f"pipelines.{name}.{kind}", table[kind])
            for option in GIVEN:
                if option in stage:
                    raise ConfigError(f"{where} {kind}.{option} is chosen by the sweep: omit it.")
            stages[kind] = stage
    own = read_parameters(f"{where} parameters", table.get("parameters", {}))
    return PipelineTable(stages, {**common, **own})


def _check_settings(where: str, pipeline: PipelineTable, seed: int) -> None:
    """Build the pipelines with each parameter's values, and find the components they name."""
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
    places = path.split(".")
    if len(places) == 1 or places[0] not in tables:
        raise UnknownOptionError(f"The parameter {path}", [places[0]], tables)
    set_option(f"The parameter {path}", tables, places, value)
