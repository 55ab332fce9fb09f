"""Every error that a user of physx can meet: one class for each thing that can be put right."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `` Did you mean "x"?`` for the known name closest to `name`, or an empty string."""
    import difflib

    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f' Did you mean "{matches[0]}"?' if matches else ""


def listed(names: Iterable[str]) -> str:
    """Return the names sorted and separated by commas, or ``none``."""
    return ", ".join(sorted(names)) or "none"


class PhysxError(Exception):
    """Base of all errors of physx."""


# Configuration ------------------------------------------------------------------------------


class ConfigError(PhysxError):
    """A value of a configuration is not what the option takes."""


class UnknownOptionError(ConfigError):
    """An option that the configuration does not have.

    Attributes:
        owner: What was configured, for example ``EnvironmentConfig``.
        unknown: The names that nothing takes.
        known: The names that would have been taken.
    """

    def __init__(self, owner: str, unknown: Iterable[str], known: Iterable[str]) -> None:
        self.owner, self.unknown, self.known = owner, sorted(unknown), sorted(known)
        name = self.unknown[0]
        super().__init__(
            f'{owner} has no option "{name}".{nearest(name, self.known)} '
            f"Options: {listed(self.known)}."
        )


class ConfigFileError(ConfigError):
    """A configuration file is missing or is not valid TOML."""


class UsageError(PhysxError):
    """Calls that do not fit together, for example a method called outside of its phase."""


# Plugins ------------------------------------------------------------------------------------


class PluginError(PhysxError):
    """A plugin is installed but cannot be used.

    Attributes:
        plugin: Entry-point name of the plugin.
    """

    def __init__(self, plugin: str, message: str) -> None:
        self.plugin = plugin
        super().__init__(message)


class PluginNotFoundError(PhysxError):
    """No installed plugin has this entry-point name.

    Attributes:
        name: The name asked for.
        installed: Entry-point names that are installed.
    """

    def __init__(self, name: str, installed: Sequence[str], pip: str) -> None:
        self.name, self.installed = name, list(installed)
        super().__init__(
            f'No plugin "{name}" is installed. Installed: {listed(installed)}.'
            f"{nearest(name, installed)} To install it: {pip}"
        )


class ComponentNotFoundError(PhysxError):
    """The plugin, module or script is there, but not the component asked of it.

    Attributes:
        kind: Kind of the component, for example ``environment``.
        name: The name asked for.
        known: Names that exist there.
    """

    def __init__(self, kind: str, name: str, place: str, known: Iterable[str]) -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        super().__init__(
            f'{place} has no {kind} "{name}".{nearest(name, self.known)} '
            f"It has: {listed(self.known)}."
        )


class ReferenceFormError(PhysxError):
    """A component was named in a form that physx does not know."""


# Samples ------------------------------------------------------------------------------------


class SampleError(PhysxError):
    """An environment gave data that cannot be stored.

    Attributes:
        field: Name of the field, or an empty string where no field is concerned.
        instance_id: Number of the environment instance, counted from 1; 0 where none is concerned.
        step: The instance's step that gave the data, counted from 0; -1 where none is concerned.
    """

    def __init__(
        self, message: str, *, field: str = "", instance_id: int = 0, step: int = -1
    ) -> None:
        self.field, self.instance_id, self.step = field, instance_id, step
        if instance_id:
            message = f"Instance {instance_id}, step {step}: {message}"
        super().__init__(message[:1].upper() + message[1:])


class MissingFieldError(SampleError):
    """A field that was defined is not in the sample."""


class UnknownFieldError(SampleError):
    """A field in the sample that was not defined."""


class FieldShapeError(SampleError):
    """A field's value has another shape than the field."""


class FieldTypeError(SampleError):
    """A field's value has a type that the field's type cannot hold."""


class NotFiniteError(SampleError):
    """A field's value holds NaN or an infinite number."""


class WrongSamplesError(SampleError):
    """`check_sample` rejected more samples in a row than the configuration allows."""


# Environments and clients -------------------------------------------------------------------


class EnvironmentFailedError(PhysxError):
    """User code of an environment raised an exception.

    Attributes:
        instance_id: Number of the environment instance, counted from 1.
        method: Name of the method that raised, for example ``step``.
        step: The instance's step at which it happened, counted from 0; -1 before the first.
        remote_traceback: Traceback as text, as it was where the environment runs.
    """

    def __init__(
        self, instance_id: int, method: str, step: int, summary: str, remote_traceback: str
    ) -> None:
        self.instance_id, self.method, self.step = instance_id, method, step
        self.summary, self.remote_traceback = summary, remote_traceback
        at = f" at step {step}" if step >= 0 else ""
        super().__init__(f"Instance {instance_id} raised in {method}(){at}: {summary}")


class ClientError(PhysxError):
    """A client process ended, hung or could not be talked to.

    Attributes:
        instance_id: Number of the environment instance that the client runs, counted from 1.
        exit_status: Exit status of the process, negative for a signal, None while it runs.
        stderr: Last lines that the process wrote to its standard error.
    """

    def __init__(
        self, instance_id: int, message: str, *, exit_status: int | None = None, stderr: str = ""
    ) -> None:
        self.instance_id, self.exit_status, self.stderr = instance_id, exit_status, stderr
        tail = f"\nLast lines of its standard error:\n{stderr}" if stderr else ""
        super().__init__(f"Client {instance_id} {message}{tail}")


class ConnectionRefusedByPeerError(PhysxError):
    """The other side of a connection did not prove that it knows the token, or spoke nonsense."""


class UnansweredError(ConnectionRefusedByPeerError):
    """Nothing answers at an address, or the connection ended before anything was proved."""


# Sessions, datasets, checkpoints ------------------------------------------------------------


class SessionError(PhysxError):
    """A session folder is missing, or is not what the pipeline needs."""


class DatasetError(PhysxError):
    """A dataset is missing, damaged, or does not hold what was asked of it."""


class DatasetNotFoundError(DatasetError):
    """No dataset lies in this folder."""


class DatasetLockedError(DatasetError):
    """Another process writes to this dataset."""


class ExchangeError(DatasetError):
    """Rows cannot be written to, or taken from, a file of another format."""


class MissingLibraryError(PhysxError):
    """A library that is only needed for this is not installed.

    Attributes:
        library: Name of the package.
        extra: Extra that brings it.
    """

    def __init__(
        self, purpose: str, library: str, extra: str, distribution: str = "physx-core"
    ) -> None:
        self.library, self.extra = library, extra
        super().__init__(
            f'{purpose} needs the package "{library}", which is not installed. '
            f'To install it: pip install "{distribution}[{extra}]"'
        )


class FieldsMismatchError(DatasetError):
    """Fields of two things that must fit together differ.

    Attributes:
        differences: One line of text for each difference, by field name.
    """

    def __init__(self, what: str, differences: Mapping[str, str]) -> None:
        self.differences = dict(differences)
        lines = "".join(f"\n  {name}: {text}" for name, text in self.differences.items())
        super().__init__(f"{what}:{lines}")


class CheckpointError(PhysxError):
    """A checkpoint is missing, damaged, or made for another network."""


# Simulations and viewers --------------------------------------------------------------------


class ModelError(PhysxError):
    """A robot or world description cannot be loaded."""


class MissingMeshesError(ModelError):
    """Mesh files that a robot description names do not exist.

    Attributes:
        missing: Every missing file, as the description names it.
    """

    def __init__(self, model: str, missing: Sequence[str]) -> None:
        self.missing = list(missing)
        lines = "".join(f"\n  {name}" for name in self.missing)
        super().__init__(
            f"{model} names {len(self.missing)} mesh file(s) that do not exist:{lines}\n"
            "Give the folder of each package in Robot(package_dirs={name: folder})."
        )


class SimulationError(PhysxError):
    """A call that the simulation cannot carry out, or a state that is no longer finite."""


class FeatureNotSupportedError(SimulationError):
    """The engine does not have the feature that was asked for.

    Attributes:
        engine: Name of the engine.
        feature: What was asked for.
        features: What the engine has.
    """

    def __init__(
        self, engine: str, feature: str, features: Iterable[str], advice: str = ""
    ) -> None:
        self.engine, self.feature, self.features = engine, feature, sorted(features)
        super().__init__(
            f'{engine} does not have the feature "{feature}".{advice and " " + advice} '
            f"It has: {listed(self.features)}."
        )


class EpisodeError(PhysxError):
    """A call at the wrong moment of an episode, for example a step before the first reset."""


class ActionError(PhysxError):
    """An action that is no element of the action space and cannot be brought into it.

    Attributes:
        entry: Where in the action it is wrong, for example ``[2]`` or ``["arm"][0]``; empty where
            all of it is.
    """

    def __init__(self, message: str, entry: str = "") -> None:
        self.entry = entry
        super().__init__(message)


class LogError(PhysxError):
    """The log of an episode is missing or damaged, or lacks what was asked of it."""


class VisualizerError(PhysxError):
    """A viewer cannot be started, reached or written to."""


# Environments in other processes ------------------------------------------------------------


class RemoteError(PhysxError):
    """An environment in another process cannot be served, reached or driven."""


class RemoteClosedError(RemoteError):
    """The other side ended the connection, or the connection was closed here before."""


class RemoteTimeoutError(RemoteError):
    """The other side did not answer in time."""


class RemoteProtocolError(RemoteError):
    """The other side sent what the protocol does not allow."""


class RequestError(RemoteError):
    """A request to an environment cannot be carried out; the environment lives on."""
