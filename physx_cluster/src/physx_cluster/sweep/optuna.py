"""Optuna's samplers and pruners, queried in an order that no process and no kill can change."""

from __future__ import annotations

import importlib.util
import inspect
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from physx_cluster.sweep.parameters import Choices, Parameter, Setting
from physx_cluster.sweep.results import COMPLETE, FAILED, PRUNED, Result
from physx_core.errors import ConfigError, MissingLibraryError, UnknownOptionError, listed, nearest

if TYPE_CHECKING:
    from types import ModuleType

    import optuna

PREFIX = "optuna/"
_UNFIT = ("base", "grid", "bruteforce", "partialfixed", "nop", "patient")
_NAME = "study"
_NEEDS = {"optuna/cmaes": "cmaes", "optuna/qmc": "scipy", "optuna/gp": "scipy"}
"""Libraries that samplers import only in the middle of a study."""


class OptunaSearch:
    """Chooses settings with one of Optuna's samplers.

    The sampler's state is not stored: repeating the same requests and results reproduces it.
    """

    def __init__(
        self,
        sampler: str,
        kwargs: Mapping[str, Any],
        parameters: Mapping[str, Parameter],
        seed: int,
        goal: str,
    ) -> None:
        """Create the sampler.

        Args:
            sampler: Name of the sampler, for example ``optuna/tpe``.
            kwargs: Keyword arguments of the sampler.
            parameters: The parameters by name.
            seed: Seed of the sampler.
            goal: "minimize" or "maximize".

        Raises:
            ConfigError: If the sampler does not exist, or rejects its arguments.
            MissingLibraryError: If Optuna or a library that the sampler needs is not installed.
        """
        library = _import()
        made = _create(library.samplers, "Sampler", sampler, {"seed": seed, **kwargs})
        self._library = library
        self._parameters = parameters
        self._study = library.create_study(sampler=made, direction=goal, study_name=_NAME)
        self._asked: list[optuna.Trial] = []

    def ask(self, count: int) -> list[Setting]:
        """Return the next settings."""
        ranges = {n: _distribution(self._library, p) for n, p in self._parameters.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", self._library.exceptions.ExperimentalWarning)
            self._asked = [self._study.ask(ranges) for _ in range(count)]
        return [
            {name: _value(each, trial.params[name]) for name, each in self._parameters.items()}
            for trial in self._asked
        ]

    def tell(self, results: Sequence[Sequence[Result]]) -> None:
        """Report the results of the last requested settings to the sampler.

        Args:
            results: For each setting, the results for all seeds. Their means count; a setting with
                a pruned result counts as pruned.
        """
        states = self._library.trial.TrialState
        for trial, of_setting in zip(self._asked, results, strict=True):
            found = {result.state for result in of_setting}
            mean = sum(result.value for result in of_setting) / len(of_setting)
            steps = set.intersection(*(set(result.numbers) for result in of_setting))
            for step in sorted(steps):
                value = sum(result.numbers[step] for result in of_setting) / len(of_setting)
                if math.isfinite(value):
                    trial.report(value, step)
            if FAILED in found or not math.isfinite(mean):
                self._study.tell(trial, state=states.FAIL)
            elif PRUNED in found:
                self._study.tell(trial, state=states.PRUNED)
            else:
                self._study.tell(trial, mean)
        self._asked = []


class Pruning:
    """Decides with one of Optuna's pruners whether a trial ends before its last epoch."""

    def __init__(
        self,
        pruner: str,
        kwargs: Mapping[str, Any],
        goal: str,
        earlier: Iterable[Result | None],
    ) -> None:
        """Create the pruner.

        Args:
            pruner: Name of the pruner, for example ``optuna/median``.
            kwargs: Keyword arguments of the pruner.
            goal: "minimize" or "maximize".
            earlier: Results of this pipeline's earlier trials, in order; None for concurrent
                trials, which must not matter.

        Raises:
            ConfigError: If the pruner does not exist, or rejects its arguments.
            MissingLibraryError: If Optuna is not installed.
        """
        library = _import()
        made = _create(library.pruners, "Pruner", pruner, kwargs)
        study = library.create_study(pruner=made, direction=goal, study_name=_NAME)
        study.add_trials([_frozen(library, result) for result in earlier])
        self._study, self._trial, self._told = study, study.ask(), 0

    def decide(self, numbers: Mapping[int, float]) -> bool:
        """Return whether the trial ends.

        Args:
            numbers: The trial's numbers so far, by epoch, including those of the last call.
        """
        ends = False
        for epoch in sorted(step for step in numbers if step > self._told):
            self._told = epoch
            if math.isfinite(numbers[epoch]):
                self._trial.report(numbers[epoch], epoch)
                ends = bool(self._trial.should_prune())
        return ends

    @property
    def rungs(self) -> dict[str, float]:
        """The pruner's records of the trial, to compare later trials with."""
        kept = self._study.get_trials(deepcopy=False)[-1].system_attrs
        return {name: float(value) for name, value in kept.items() if _is_rung(name)}


def check_optuna(
    sampler: str, sampler_kwargs: Mapping[str, Any], pruner: str | None, kwargs: Mapping[str, Any]
) -> None:
    """Check that Optuna has a sampler and a pruner; samplers that are not Optuna's are ignored.

    Raises:
        ConfigError: If one of them does not exist.
        MissingLibraryError: If Optuna is needed but not installed.
    """
    if sampler.startswith(PREFIX):
        _create(_import().samplers, "Sampler", sampler, {"seed": 0, **sampler_kwargs})
    if pruner is not None:
        _create(_import().pruners, "Pruner", pruner, kwargs)


def _import() -> Any:
    try:
        import optuna
    except ImportError:
        raise MissingLibraryError(
            'A sampler or pruner "optuna/..."', "optuna", "optuna", "physx-cluster"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


def known_samplers() -> list[str]:
    """Return the names of Optuna's samplers; empty if it is not installed."""
    try:
        return list(_classes(_import().samplers, "Sampler"))
    except MissingLibraryError:
        return []


def _classes(module: ModuleType, kind: str) -> dict[str, str]:
    """Return the classes of a kind by the names that users specify."""
    found = {_short(name, kind): name for name in dir(module) if name.endswith(kind)}
    return {PREFIX + name: made for name, made in found.items() if not name.startswith(_UNFIT)}


def _create(module: ModuleType, kind: str, reference: str, kwargs: Mapping[str, Any]) -> Any:
    known = _classes(module, kind)
    if reference not in known:
        others = ["grid", "random", *known] if kind == "Sampler" else known
        raise ConfigError(
            f'There is no {kind.lower()} "{reference}".{nearest(reference, others)} '
            f"Available: {listed(others)}."
        )
    make = getattr(module, known[reference])
    names = inspect.signature(make).parameters
    unknown = kwargs.keys() - names.keys()
    if unknown:
        raise UnknownOptionError(f'The {kind.lower()} "{reference}"', unknown, names)
    needed = _NEEDS.get(reference)
    if needed is not None and importlib.util.find_spec(needed) is None:
        raise MissingLibraryError(f'"{reference}"', needed, "optuna", "physx-cluster")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # many are experimental
            return make(**kwargs)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f'The {kind.lower()} "{reference}" rejects its arguments: {error}'
        ) from None


def _short(name: str, kind: str) -> str:
    """Return a class's name in words: ``successive_halving`` for SuccessiveHalvingPruner."""
    plain = name.removesuffix(kind)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z][a-z]+", plain)
    return "_".join(words).lower() if kind == "Pruner" else plain.lower()


def _distribution(library: Any, parameter: Parameter) -> Any:
    made = library.distributions
    if isinstance(parameter, Choices):
        return made.CategoricalDistribution(range(len(parameter.values)))
    if parameter.is_whole:
        return made.IntDistribution(int(parameter.low), int(parameter.high), log=parameter.log)
    return made.FloatDistribution(parameter.low, parameter.high, log=parameter.log)


def _value(parameter: Parameter, suggested: Any) -> Any:
    return parameter.values[suggested] if isinstance(parameter, Choices) else suggested


def _frozen(library: Any, result: Result | None) -> Any:
    """Return a trial in Optuna's form; one that must not matter is declared as failed."""
    states = library.trial.TrialState
    if result is None or result.state == FAILED or not math.isfinite(result.value):
        return library.trial.create_trial(state=states.FAIL)
    numbers = {step: value for step, value in result.numbers.items() if math.isfinite(value)}
    return library.trial.create_trial(
        state=states.COMPLETE if result.state == COMPLETE else states.PRUNED,
        value=result.value,
        intermediate_values=numbers,
        system_attrs=dict(result.rungs),
    )


def _is_rung(name: str) -> bool:
    return name.startswith("completed_rung_")
