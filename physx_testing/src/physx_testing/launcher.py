"""Contract checks for launchers."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from physx_core.components import ClientHandle, Launcher
from physx_core.config import EnvironmentConfig
from physx_core.errors import ClientError, PhysxError
from physx_core.net import format_address
from physx_core.processes import describe_exit
from physx_core.sources import ClientSource, LocalSource
from physx_core.typing import Batch
from physx_testing.instances import Services
from physx_testing.process_state import unchanged
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, run_checks
from physx_testing.subject import (
    Check,
    Subject,
    expect,
    expect_equal,
    refuses_unknown_options,
)

_PROBES = "physx_testing.probes"
_SEED = (5, 0, 0)
_ROWS = 12
_PATIENCE = 45.0
"""Seconds within which clients must have started or ended; a cluster may take a while."""
_LEFT_PATIENCE = 10.0
"""Seconds within which everything that belonged to an ended client must be gone."""
_MOMENT = 1.0
"""Seconds within which a client killed along with another one has ended."""
_POLL = 0.02


def check_launcher(
    component: str | type[Any] | Callable[..., Launcher],
    *,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a launcher satisfies the contract of `Launcher`, repeatedly starting two clients.

    Leftovers are searched for on this machine and among the connections that the clients made.

    Args:
        component: Its class, a function that returns it, or a reference.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "launcher",
        component,
        kwargs,
        expected_failures=expected_failures,
        timeout=timeout,
    )


class _Door:
    """Listens for clients and sends nothing, or the same text to each."""

    def __init__(self, host: str, answer: bytes = b"") -> None:
        self._socket = socket.create_server((host, 0))
        self._socket.settimeout(_POLL)
        self._answer = answer
        self.address = format_address(host, self._socket.getsockname()[1])
        self.connections: list[socket.socket] = []

    def open_to(self, count: int) -> bool:
        """Wait for connections; return whether there were enough in time."""
        until = time.monotonic() + _PATIENCE
        while len(self.connections) < count and time.monotonic() < until:
            self.accept()
        return len(self.connections) >= count

    def accept(self) -> None:
        """Accept a connection if there is one."""
        with contextlib.suppress(TimeoutError):
            connection, _ = self._socket.accept()
            self.connections.append(connection)
            if self._answer:
                with contextlib.suppress(OSError):
                    connection.sendall(self._answer)

    def are_gone(self) -> bool:
        """Wait for all connections to end; return whether they ended in time."""
        until = time.monotonic() + _PATIENCE
        for connection in self.connections:
            connection.settimeout(max(until - time.monotonic(), _POLL))
            try:
                while connection.recv(1 << 12):
                    pass
            except TimeoutError:
                return False
            except ConnectionError:
                continue
        return True

    def close(self) -> None:
        """Close everything."""
        for each in (*self.connections, self._socket):
            each.close()


class _Launched(NamedTuple):
    """Clients that were started, and the door that keeps them waiting."""

    launcher: Launcher
    handles: Sequence[ClientHandle]
    door: _Door
    token: str


@contextlib.contextmanager
def _launched(
    subject: Subject, instances: Sequence[int] = (1, 2), answer: bytes = b""
) -> Iterator[_Launched]:
    launcher: Launcher = subject.make()
    host = launcher.open()
    try:
        if launcher.by_hand:
            found = launcher.launch([1], "127.0.0.1:1", "token")
            expect(found == [], f"it says by_hand = True, but launch() returned {found}")
            raise NotApplicableError("clients are started by hand")
        door, token = _Door(host or "127.0.0.1", answer), secrets.token_hex(16)
        handles: Sequence[ClientHandle] = []
        try:
            handles = launcher.launch(list(instances), door.address, token)
            yield _Launched(launcher, handles, door, token)
        finally:
            with contextlib.ExitStack() as ended:
                ended.callback(door.close)
                for handle in handles:
                    ended.callback(handle.wait, time.monotonic() + _PATIENCE)
                    ended.callback(handle.kill)
    finally:
        launcher.close()


def _refuses(subject: Subject) -> None:
    refuses_unknown_options(subject, _start)


def _start(subject: Subject) -> None:
    if not subject.make().by_hand:
        with _launched(subject, (1,)):
            pass


def _starts(subject: Subject) -> None:
    with _launched(subject, (1, 2, 4)) as run:
        numbers = [handle.instance_id for handle in run.handles]
        expect(numbers == [1, 2, 4], f"for instances 1, 2, 4 the handles are for {numbers}")
        expect(run.door.open_to(3), f"only {len(run.door.connections)} of 3 clients connected")
        for handle in run.handles:
            status = handle.exit_status()
            expect(status is None, f"exit_status() of a running client is {status}")


def _hides_token(subject: Subject) -> None:
    with _launched(subject) as run:
        run.door.open_to(2)
        mark = run.token.encode()
        shown = [text for _, text in _processes("cmdline") if mark in text]
        expect(not shown, "the token is on a command line, which everybody can read")


def _processes(what: str) -> Iterator[tuple[int, bytes]]:
    """Yield the pid and the environment or command line of every process that we may inspect."""
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            yield int(process.name), (process / what).read_bytes()


def _marked(mark: str) -> list[str]:
    """Return the command lines of other processes with a text in their environment."""
    own, found = os.getpid(), []
    for number, text in _processes("environ"):
        if mark.encode() in text and number != own:
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{number}/cmdline").read_bytes()
                if words:  # empty for a dead process
                    found.append(words.replace(b"\0", b" ").decode(errors="replace"))
    return found


def _expect_gone(mark: str, after: str) -> None:
    until = time.monotonic() + _LEFT_PATIENCE
    while left := _marked(mark):
        expect(time.monotonic() < until, f"after {after} there is still: {left[0][:120]}")
        time.sleep(_POLL)


def _ends(subject: Subject, how: str) -> None:
    with _launched(subject) as run:
        expect(run.door.open_to(2), "the clients did not connect")
        for handle in run.handles:
            getattr(handle, how)()
        for handle in run.handles:
            ended = handle.wait(time.monotonic() + _PATIENCE)
            expect(ended, f"a client has not ended after {how}()")
            status = handle.exit_status()
            expect(
                isinstance(status, int) and status != 0,
                f"exit_status() of a client after {how}() is {status!r}, as if it had done its "
                "work",
            )
        expect(run.door.are_gone(), f"a client is still connected after {how}()")
        _expect_gone(run.token, f"{how}()")
        for handle in run.handles:  # a second time, which must do nothing
            handle.terminate()
            handle.kill()
            expect(handle.exit_status() is not None, "a client that had ended is running again")


def _terminates(subject: Subject) -> None:
    _ends(subject, "terminate")


def _kills(subject: Subject) -> None:
    _ends(subject, "kill")


def _one_of_two(subject: Subject) -> None:
    with _launched(subject) as run:
        expect(run.door.open_to(2), "the clients did not connect")
        first, second = run.handles
        first.kill()
        expect(first.wait(time.monotonic() + _PATIENCE), "a client has not ended after kill()")
        ended = second.wait(time.monotonic() + _MOMENT)
        text = f"kill() of a client ended another one, with status {second.exit_status()}"
        expect(not ended, text)


def _tells(subject: Subject) -> None:
    with _launched(subject, (1,), answer=b"HTTP/1.1 400 Bad Request\r\n\r\n") as run:
        (handle,) = run.handles
        until = time.monotonic() + _PATIENCE
        while handle.exit_status() is None and time.monotonic() < until:
            run.door.accept()
        status = handle.exit_status()
        expect(status is not None, "a client that was turned away by its server has not ended")
        assert status is not None
        expect(
            status > 0,
            f"a client that was turned away exits with a status above 0, but exit_status() says "
            f"it {describe_exit(status)}",
        )
        if type(handle).stderr is ClientHandle.stderr:
            raise NotApplicableError("it does not keep what clients write: see stderr()")
        text = handle.stderr()
        expect(
            "physx client" in text,
            f"stderr() is not what the client wrote before it ended, but {text!r}",
        )


def _config(subject: Subject, probe: str, **options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(
        f"{_PROBES}:{probe}",
        num_clients=2,
        launcher=subject.reference,
        launcher_kwargs=dict(subject.arguments),
        **options,
    )


def _by_hand(subject: Subject) -> None:
    if subject.make().by_hand:
        raise NotApplicableError("clients are started by hand")


def _wanted() -> Batch:
    config = EnvironmentConfig(f"{_PROBES}:Counting", num_clients=2, as_tcp_ip_client=False)
    with LocalSource(config, Services(), _SEED) as source:
        return {name: values.copy() for name, values in source.batch(_ROWS).items()}


def _same_rows(subject: Subject) -> None:
    _by_hand(subject)
    config = _config(subject, "Counting")
    with ClientSource(config, Services(), _SEED, total=_ROWS) as source:
        expect_equal(
            source.batch(_ROWS), _wanted(), "its clients' rows differ from those generated here"
        )


def _restarts(subject: Subject) -> None:
    _by_hand(subject)
    folder = str(subject.folder)
    config = _config(subject, "Dying", env_kwargs={"folder": folder}, retries=1)
    with ClientSource(config, Services(), _SEED, total=_ROWS) as source:
        found = source.batch(_ROWS)
        expect_equal(found, _wanted(), "after a client was killed and restarted, rows differ")
    expect(any(subject.folder.iterdir()), "no client was killed")


def _stubborn(subject: Subject) -> None:
    _by_hand(subject)
    mark, error = secrets.token_hex(16), None
    for timeout in (1.0, 20.0):  # clients start slowly on a busy machine
        config = _config(subject, "Stubborn", env_kwargs={"mark": mark}, timeout=timeout)
        started = False
        try:
            with ClientSource(config, Services(), _SEED, total=_ROWS) as source:
                expect(len(_marked(mark)) >= 2, "the clients' own processes are not running")
                started = True
                source.batch(_ROWS)
        except ClientError as caught:
            error = caught
        except PhysxError as caught:
            raise AssertionError(f"a client that hangs is reported as {caught}") from caught
        else:
            raise AssertionError("a client that hangs produced rows")
        _expect_gone(mark, "the end of a run whose clients hang and ignore SIGTERM")
        if started:
            return
    raise AssertionError(f"the clients did not start: {error}")


def _quiet(subject: Subject) -> None:
    _by_hand(subject)
    for tries in range(2):
        with (
            unchanged(subject.before) if tries else contextlib.nullcontext(),
            _launched(subject, (1,)) as run,
        ):
            expect(run.door.open_to(1), "the client did not connect")


CHECKS: dict[str, Check] = {
    "refuses unknown options": _refuses,
    "starts a client for each instance": _starts,
    "keeps the token off command lines": _hides_token,
    "terminates clients": _terminates,
    "kills clients": _kills,
    "kills one client alone": _one_of_two,
    "reports how a client ended, and its last output": _tells,
    "runs clients that give the same rows": _same_rows,
    "starts a killed client again": _restarts,
    "cleans up after clients that hang": _stubborn,
    "leaves its process as it was": _quiet,
}
