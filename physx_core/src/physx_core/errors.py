"""The errors of physx, one class for each kind of problem that a user can fix.

Plugins raise these errors too. The command line reports them without a traceback.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from physx_core.origin import install_hint


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `` Did you mean "x"?`` for the known name closest to `name`, or an empty string."""
    import difflib

    lowered = {other.lower(): other for other in known}
    matches = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
    return f' Did you mean "{lowered[matches[0]]}"?' if matches else ""


def listed(names: Iterable[str]) -> str:
    """Return the names sorted and separated by commas, or ``none``."""
    return ", ".join(sorted(names)) or "none"


def _listed_near(name: str, known: Sequence[str]) -> str:
    """Return the known names; if there are many, the closest ones and the number of others."""
    import difflib

    if len(known) <= 20:
        return listed(known)
    near = difflib.get_close_matches(name, known, n=8, cutoff=0.0)
    return f"{listed(near)} and {len(known) - len(near)} others (physx plugins)"


def found_at(place: Path) -> str:
    """Return what is at a path at which something is missing, as the end of a message."""
    if place.is_file():
        return "It is a file: give the folder of a session or dataset."
    if place.is_dir():
        return f"The folder contains: {listed(path.name for path in place.iterdir())}."
    missing = place.absolute()
    while not missing.parent.is_dir():
        missing = missing.parent
    around = [path.name for path in missing.parent.iterdir()]
    return (
        f"The folder {missing} does not exist.{nearest(missing.name, around)} {missing.parent} "
        f"contains: {listed(around)}."
    )


def printable(text: object) -> str:
    """Escape everything in a text that could control a terminal; keep line breaks and tabs.

    Names in files and in package metadata are not trusted.
    """
    return "".join(
        each if each.isprintable() or each in "\n\t" else ascii(each)[1:-1] for each in str(text)
    )


def own_line(error: BaseException) -> str:
    """Return the innermost line of the user's own code that an error came through.

    Own code is what is neither installed nor part of physx's core.

    Returns:
        The line, as in ``cloth.py:14: self.force = forces[3]``; empty if there is none.
    """
    import linecache
    import sysconfig
    import traceback
    from pathlib import Path

    foreign = ("<", *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))
    for frame, number in reversed(list(traceback.walk_tb(error.__traceback__))):
        file, module = frame.f_code.co_filename, str(frame.f_globals.get("__name__"))
        if not file.startswith(foreign) and module.partition(".")[0] != "physx_core":
            text = linecache.getline(file, number).strip()
            return f"{Path(file).name}:{number}: {text}".removesuffix(": ")
    return ""


class PhysxError(Exception):
    """Base class of all physx errors."""

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook shows: the message, as a terminal does."""
        return [f"{type(self).__name__}: {self}", *getattr(self, "__notes__", [])]


# Configuration ------------------------------------------------------------------------------


class ConfigError(PhysxError):
    """A configuration value is invalid."""


class UnknownOptionError(ConfigError):
    """A configuration has no option of this name.

    Attributes:
        owner: The configuration, for example ``EnvironmentConfig``.
        unknown: The unknown option names.
        known: The valid option names.
    """

    def __init__(self, owner: str, unknown: Iterable[str], known: Iterable[str]) -> None:
        self.owner, self.unknown, self.known = owner, sorted(map(str, unknown)), sorted(known)
        name = self.unknown[0]
        super().__init__(
            f'{owner} has no option "{name}".{nearest(name, self.known)} '
            f"Options: {listed(self.known)}."
        )


class UnknownArgumentError(UnknownOptionError, TypeError):
    """A constructor has no argument of this name.

    Also a `TypeError` with Python's wording: Gymnasium and TorchRL pass arguments that an
    environment may not accept, and recognize this wording to retry without them.
    """

    def __init__(self, owner: str, unknown: Iterable[str] = (), known: Iterable[str] = ()) -> None:
        """Describe the error.

        Args:
            owner: Name of the class. Without unknown arguments: the whole message, because
                Gymnasium re-raises an error with an extended text.
            unknown: Names of the unknown arguments.
            known: Names of the arguments that the class accepts.
        """
        self.owner, self.unknown, self.known = owner, sorted(map(str, unknown)), sorted(known)
        message = owner
        if self.unknown:
            name = self.unknown[0]
            message = (
                f"{owner}.__init__() got an unexpected keyword argument '{name}'."
                f"{nearest(name, self.known)} Options: {listed(self.known)}."
            )
        ConfigError.__init__(self, message)


class ConfigFileError(ConfigError):
    """A configuration file is missing or is not valid TOML."""


class UsageError(PhysxError):
    """A call is invalid, for example a method is called outside its phase."""


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
        name: The requested name.
        installed: Entry-point names of the installed plugins.
    """

    def __init__(
        self, name: str, installed: Sequence[str], hint: str, meant: Sequence[str] = ()
    ) -> None:
        self.name, self.installed = name, list(installed)
        guess = f" Did you mean {' or '.join(meant)}?" if meant else nearest(name, installed)
        text = f'No plugin "{name}" is installed.{guess} Installed: {listed(installed)}. {hint}'
        super().__init__(text.rstrip())


class ComponentNotFoundError(PhysxError):
    """The plugin, module, or script exists but does not have the requested component.

    Attributes:
        kind: Kind of the component, for example ``environment``.
        name: The requested name.
        known: Names of the components that it has.
    """

    def __init__(
        self, kind: str, name: str, place: str, known: Iterable[str], hint: str = ""
    ) -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        hint = hint or f"It has: {_listed_near(name, self.known)}."
        what = f'has no {kind} "{name}".{nearest(name, self.known)}'
        if not name:
            what = f"has several of kind {kind}: name one." if self.known else f"has no {kind}."
        super().__init__(f"{place} {what} {hint}")


class ContractError(PhysxError):
    """A component does not fulfill the contract of its kind."""


class ReferenceFormError(PhysxError):
    """A reference is malformed, or does not name a component of the right kind."""


class UntrustedReferenceError(PhysxError):
    """A file names code that is not a component of an installed plugin."""


# Samples ------------------------------------------------------------------------------------


class SampleError(PhysxError):
    """An environment set data that cannot be stored.

    Attributes:
        field: Name of the field; empty if the error does not concern a single field.
        instance_id: Number of the environment instance, from 1; 0 if unknown.
        step: The instance's step that set the data, from 0; -1 if unknown.
    """

    def __init__(
        self, message: str, *, field: str = "", instance_id: int = 0, step: int = -1
    ) -> None:
        self.field, self.instance_id, self.step = field, instance_id, step
        if instance_id:
            message = f"Instance {instance_id}, step {step}: {message}"
        elif field:
            message = message[:1].upper() + message[1:]
        super().__init__(message)

    def at(self, instance_id: int, step: int) -> SampleError:
        """Return this error with its instance and step added."""
        text = str(self)
        text = text[:1].lower() + text[1:]
        return type(self)(text, field=self.field, instance_id=instance_id, step=step)


class MissingFieldError(SampleError):
    """A defined field is missing from the sample."""


class UnknownFieldError(SampleError):
    """A field in the sample is not defined."""


class FieldShapeError(SampleError):
    """A value does not have the shape of its field."""


class FieldTypeError(SampleError):
    """A value cannot be represented in the type of its field."""


class NotFiniteError(SampleError):
    """A value contains NaN or infinity."""


class FailedEpisodesError(PhysxError):
    """Too many independent episodes failed.

    Attributes:
        failed: How many have failed in this run.
        episode: Number of the last one.
        remote_traceback: Where the environment raised, as text; empty if it did not raise.
    """

    def __init__(self, failed: int, episode: int, reason: str) -> None:
        self.failed, self.episode = failed, episode
        first, _, self.remote_traceback = reason.partition("\n")
        others = f", after {failed - 1} others," if failed > 1 else ""
        super().__init__(
            f"Episode {episode}{others} failed: {first.rstrip('.')}. What has been simulated is "
            "stored. To go on with the others: --resume, and --max-failed for more failures; "
            "physx generate --retry-failed simulates those that failed again."
        )


class WrongSamplesError(SampleError):
    """`check_sample` rejected more consecutive samples than the configuration allows."""


# Environments and clients -------------------------------------------------------------------


class EnvironmentFailedError(PhysxError):
    """An environment's own code raised an exception.

    Attributes:
        instance_id: Number of the environment instance, from 1.
        method: Name of the method that raised, for example ``step``.
        step: The instance's step at which it raised, from 0; -1 before the first.
        remote_traceback: Traceback from the environment's process, as text.
    """

    def __init__(
        self, instance_id: int, method: str, step: int, summary: str, remote_traceback: str
    ) -> None:
        self.instance_id, self.method, self.step = instance_id, method, step
        self.summary, self.remote_traceback = summary, remote_traceback
        at = f" at step {step}" if step >= 0 else ""
        super().__init__(f"Instance {instance_id} raised in {method}(){at}: {summary}")


class ClientError(PhysxError):
    """A client process exited, hung, or could not be reached.

    Attributes:
        instance_id: Number of the client's environment instance, from 1.
        exit_status: Exit status of the process, negative for a signal, None while it runs.
        stderr: Last lines of its standard error.
    """

    def __init__(
        self,
        instance_id: int,
        message: str,
        *,
        exit_status: int | None = None,
        stderr: str = "",
    ) -> None:
        self.instance_id, self.exit_status, self.stderr = instance_id, exit_status, stderr
        tail = f"\nLast lines of its standard error:\n{stderr}" if stderr else ""
        super().__init__(f"Client {instance_id} {message}{tail}")


class TooFewClientsError(PhysxError):
    """A run of independent episodes has had fewer clients than it needs for too long.

    Attributes:
        clients: Number of clients.
        needed: Number of clients that the run needs.
    """

    def __init__(self, clients: int, needed: int, message: str) -> None:
        self.clients, self.needed = clients, needed
        super().__init__(message)


class DependentEpisodeError(PhysxError):
    """An episode that is said to be independent had other rows when it was simulated again.

    Attributes:
        episode: Its number.
        field: Name of a field that differs; empty if the number of rows does.
        row: Number of the first such row in the episode.
    """

    def __init__(self, episode: int, field: str, row: int, message: str) -> None:
        self.episode, self.field, self.row = episode, field, row
        super().__init__(message)


class StateError(PhysxError):
    """The state of an environment cannot be captured or restored.

    Attributes:
        path: What cannot be captured, as an attribute of the environment; empty: see the message.
        kind: Its type.
    """

    def __init__(self, message: str, path: str = "", kind: str = "") -> None:
        super().__init__(message)
        self.path, self.kind = path, kind


class ProgramError(PhysxError):
    """A program that generates an environment's samples failed, hung, or violated the protocol.

    Attributes:
        program: The program and its arguments, as in a shell.
        exit_status: Exit status of the process, negative for a signal, None while it runs.
        stderr: Last lines of its standard error.
    """

    def __init__(
        self, program: str, message: str, *, exit_status: int | None = None, stderr: str = ""
    ) -> None:
        self.program, self.exit_status, self.stderr = program, exit_status, stderr
        tail = f"\nLast lines of its standard error:\n{stderr}" if stderr else ""
        super().__init__(f"The program {program} {message}{tail}")


class ConnectionRefusedByPeerError(PhysxError):
    """The other side of a connection failed to authenticate or violated the protocol."""


class UnansweredError(ConnectionRefusedByPeerError):
    """Nothing responds at an address, or the connection ended before authentication."""


class SilentPeerError(UnansweredError):
    """The process that listens at an address did not respond in time."""


# Sessions, datasets, checkpoints ------------------------------------------------------------


class SessionError(PhysxError):
    """A session folder is missing, or does not fit the pipeline."""


class DatasetError(PhysxError):
    """A dataset is missing, damaged, or lacks the requested data."""


class DatasetNotFoundError(DatasetError):
    """A folder does not contain a dataset."""


class DatasetLockedError(DatasetError):
    """Another process is writing to the dataset."""


class MissingLibraryError(PhysxError):
    """An optional library is not installed.

    Attributes:
        library: Name of the package.
        extra: Name of the extra that installs it.
    """

    def __init__(
        self, purpose: str, library: str, extra: str, distribution: str = "physx-core"
    ) -> None:
        self.library, self.extra = library, extra
        super().__init__(
            f'{purpose} needs the package "{library}", which is not installed. '
            f"{install_hint(distribution, extra)}"
        )


class FieldsMismatchError(DatasetError):
    """Fields that must match differ.

    Attributes:
        differences: One line of text for each difference, by field name.
    """

    def __init__(self, what: str, differences: Mapping[str, str]) -> None:
        self.differences = dict(differences)
        lines = "".join(f"\n  {name}: {text}" for name, text in self.differences.items())
        super().__init__(f"{what}:{lines}")


class CheckpointError(PhysxError):
    """A checkpoint is missing, damaged, or belongs to another network."""


class DivergedError(PhysxError):
    """A loss, gradient, or parameter became NaN or infinite during training.

    Attributes:
        epoch: The epoch, counted from 1; 0 if it does not apply.
        batch: The batch in the epoch, counted from 1; 0 if it does not apply.
    """

    def __init__(self, message: str, *, epoch: int = 0, batch: int = 0) -> None:
        self.epoch, self.batch = epoch, batch
        if epoch:
            message = (
                f"Epoch {epoch}, batch {batch}: {message}"
                if batch
                else (f"Epoch {epoch}: {message}")
            )
        super().__init__(message)


# Simulations and viewers --------------------------------------------------------------------


class EpisodeError(PhysxError):
    """A call came at the wrong time in an episode, for example a step before the first reset."""


class ActionError(PhysxError):
    """An action is not in the action space and cannot be converted.

    Attributes:
        entry: The invalid entry of the action, for example ``[2]`` or ``["arm"][0]``; empty if the
            whole action is invalid.
    """

    def __init__(self, message: str, entry: str = "") -> None:
        self.entry = entry
        super().__init__(message)


class VisualizerError(PhysxError):
    """A viewer cannot be started, reached or written to."""
