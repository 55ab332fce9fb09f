"""ExternalProgram: an environment whose samples come from a program in any language."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from physx_core.components.environment import Environment
from physx_core.components.parameter import Parameter
from physx_core.errors import (
    ConfigError,
    SampleError,
    StateError,
    UnknownOptionError,
    listed,
    nearest,
)
from physx_core.external import INCLUDE
from physx_core.external.messages import Kind, Message
from physx_core.external.process import ProgramProcess
from physx_core.fields import Field
from physx_core.typing import Array

_OPTIONS = {field.name: field for field in dataclasses.fields(Parameter) if field.name != "name"}


class ExternalProgram(Environment):
    """Starts a program and takes one sample from it in each step.

    The program is compiled with ``physx.h`` or ``physx.f90`` from the folder that ``physx include``
    prints, or is a script in any Python that imports ``physx.py`` from there. It declares the
    fields itself. If it ends normally and more samples are needed, it is started again, which
    begins a new episode, as does a request for parameters after a sample.
    """

    runs_programs: ClassVar[bool] = True

    def __init__(
        self,
        *,
        program: str | Sequence[str],
        parameters: Mapping[str, Any] | None = None,
        ranges: Mapping[str, Sequence[Any] | Mapping[str, Any]] | None = None,
        additional: Sequence[str] = (),
        units: Mapping[str, str] | None = None,
        timeout: float = 50.0,
        **kwargs: Any,
    ) -> None:
        """Keep the arguments.

        Args:
            program: The program and its arguments. Paths are relative to the working directory.
            parameters: Numbers and arrays that the program may request by name, in addition to
                ``seed`` (from 0 to 2**31 - 1, different in each episode), ``instance_id``,
                ``instance_nb``, and ``episode``.
            ranges: Parameters that the run's sampler chooses for each episode, or that are drawn:
                name to ``[low, high]``, or to a table of the arguments of `Parameter`.
            additional: Names of fields that are stored, but not read by networks.
            units: Units of fields by name.
            timeout: Longest time in s that the program may keep the environment waiting. If it is
                shorter than that of `EnvironmentConfig`, the error tells what the program did.
            kwargs: See `Environment`.

        Raises:
            ConfigError: If an argument is malformed.
        """
        super().__init__(**kwargs)
        command = [program] if isinstance(program, str) else program
        if not (isinstance(command, Sequence) and command and all(map(_is_word, command))):
            raise ConfigError(
                f'program must be a list of strings such as ["./heat", "0.1"], not {program!r}.'
            )
        if not (isinstance(timeout, (int, float)) and timeout > 0):
            raise ConfigError(f"timeout must be a number of seconds above 0, not {timeout!r}.")
        self._command, self._timeout = list(command), timeout
        self._fixed, self._additional_names = dict(parameters or {}), list(additional)
        self._ranges = [_as_parameter(name, given) for name, given in (ranges or {}).items()]
        self._units = dict(units or {})
        self._chosen: dict[str, Any] = {}
        names = [*self._own_parameters(), *self._fixed, *(each.name for each in self._ranges)]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ConfigError(
                f"The parameters {listed(twice)} are given more than once: in parameters, in "
                f"ranges, or by physx, which gives {listed(self._own_parameters())}."
            )
        self._process: ProgramProcess | None = None
        self._declared: Sequence[Field] = ()
        self._seed: int | None = None
        self._held: Message | None = None  # a request that the next episode answers
        self._is_new = True  # whether the episode has no sample yet

    def create(self) -> None:
        """Start the program."""
        self.define_parameters(self._ranges)
        self._process, self._declared = self._start()

    def init_database(self) -> None:
        """Define the fields that the program declared."""
        fields = {field.name: field for field in self._declared}
        for name in (*self._additional_names, *self._units):
            if name not in fields:
                raise ConfigError(
                    f'The program declares no field "{name}".{nearest(name, fields)} '
                    f"It declares: {listed(fields)}."
                )
        for name, unit in self._units.items():
            fields[name] = dataclasses.replace(fields[name], unit=unit)
        additional = [fields.pop(name) for name in dict.fromkeys(self._additional_names)]
        self.define_training_fields(fields.values())
        self.define_additional_fields(additional)

    def reset_parameters(self, **values: Any) -> None:
        """Keep the values until the program requests them.

        For an independent episode, a program that has ended or is in the middle of another one is
        started again.
        """
        self._chosen = values
        if self.independent_episodes:
            assert self._process is not None
            if self._process.is_over or (not self._is_new and self._held is None):
                self._start_again()
            self._is_new, self._seed = True, None

    def step(self) -> None:
        """Take the program's next sample, answering requests that precede it."""
        while True:
            assert self._process is not None
            message, self._held = self._held or self._process.receive(), None
            if message.kind is Kind.SAMPLE:
                self._process.samples += 1
                self._is_new = False
                given, names = message.given, self._additional_names
                additional = {name: given.pop(name) for name in names if name in given}
                self.set_training_data(**given)
                self.set_additional_data(**additional)
                return
            ends = message.kind is Kind.PARAMETERS and not self._is_new
            if ends and self.independent_episodes:
                self._held = message
                self.end_episode()
                return
            if message.kind is Kind.PARAMETERS:
                self._answer_parameters(self._process, message)
            elif message.kind is Kind.PREDICT:
                self._answer_prediction(self._process, message)
            elif message.kind is Kind.CLOSE:
                self._end(self._process)
                if self.independent_episodes:
                    self.end_episode()
                    return
                self._begin_episode()
                self._start_again()
            else:
                raise self._process.error("called physx_open() twice.")

    def get_state(self) -> Any:
        """Refuse: a program's state is in its own memory.

        Raises:
            StateError: Always.
        """
        raise StateError(
            f"The state of {self._command[0]} is in its own memory, so there can be no state of "
            "this environment: let its episodes be independent, which need none."
        )

    def set_state(self, state: Any) -> None:
        """Refuse, as `get_state` does."""
        self.get_state()

    def close(self) -> None:
        """End the program."""
        process, self._process = self._process, None
        if process is not None:
            process.close()

    def _start(self) -> tuple[ProgramProcess, Sequence[Field]]:
        """Start the program, and return it and the fields that it declares."""
        path = filter(None, (os.environ.get("PYTHONPATH"), str(INCLUDE)))
        variables = {
            "PHYSX_INSTANCE": str(self.instance_id),
            "PYTHONPATH": os.pathsep.join(path),  # the program may be a script that imports physx
        }
        process = ProgramProcess(self._command, variables, self._timeout)
        return process, process.fields

    def _end(self, process: ProgramProcess) -> None:
        """Wait until a program that has sent all its samples has ended normally."""
        if not process.samples:
            raise process.error("called physx_close() without having sent a sample.")
        process.end()

    def _start_again(self) -> None:
        """Start the program once more."""
        self.close()
        self._held = None
        self._process, declared = self._start()
        if declared != self._declared:
            raise self._process.error(
                f"declared different fields when it was started again: {declared}, not "
                f"{self._declared}."
            )

    def _begin_episode(self) -> None:
        self.new_episode()
        self._is_new, self._seed = True, None

    def _own_parameters(self) -> dict[str, Any]:
        """Return the parameters of every program; the seed is not drawn yet."""
        return {
            "seed": 0,
            "instance_id": self.instance_id,
            "instance_nb": self.instance_nb,
            "episode": self.episode_index,
        }

    def _answer_parameters(self, process: ProgramProcess, message: Message) -> None:
        if not self._is_new:
            self._begin_episode()
        if self._seed is None:
            self._seed = int(self.rng.integers(2**31))
        own = {**self._own_parameters(), "seed": self._seed}
        values = {**self._fixed, **self._chosen, **own}
        process.answer(_converted(process, "parameter", values, message.wanted))

    def _answer_prediction(self, process: ProgramProcess, message: Message) -> None:
        if not message.given:
            raise process.error("called physx_predict() without inputs.")
        values = dict(self.get_prediction(**message.given))
        process.answer(_converted(process, "prediction", values, message.wanted))


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and bool(value) and "\0" not in value


def _as_parameter(name: str, given: Any) -> Parameter:
    if isinstance(given, Mapping):
        if unknown := given.keys() - _OPTIONS.keys():
            raise UnknownOptionError(f'The range of the parameter "{name}"', unknown, _OPTIONS)
        return Parameter(name, **given)
    if isinstance(given, Sequence) and not isinstance(given, str) and len(given) == 2:
        return Parameter(name, *given)
    raise ConfigError(
        f"ranges must have [low, high] or a table such as {{low=0.1, high=10.0, distribution="
        f'"log_uniform"}} for the parameter "{name}", not {given!r}.'
    )


def _converted(
    process: ProgramProcess, what: str, values: Mapping[str, Any], wanted: Sequence[Field]
) -> dict[str, Array]:
    return {field.name: _convert(process, what, values, field) for field in wanted}


def _convert(process: ProgramProcess, what: str, values: Mapping[str, Any], field: Field) -> Array:
    """Return one of the values in the type and shape that the program requests."""
    name = field.name
    if name not in values:
        raise process.error(
            f'asked for the {what} "{name}", which does not exist.{nearest(name, values)} '
            f"Available: {listed(values)}."
        )
    try:
        return field.convert(values[name])
    except SampleError as error:
        raise process.error(
            f'asked for the {what} "{name}" as {field.numpy_dtype} of shape {field.shape}: {error}'
        ) from None
