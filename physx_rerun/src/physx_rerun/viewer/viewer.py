"""Viewer: the native Rerun viewer in a separate process, reachable only from this machine."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import rerun_cli

from physx_core.errors import VisualizerError
from physx_core.processes import ChildProcess, OutputTail

_PANIC_STATUS = 102
_PANIC = re.compile(r"panicked at '(.*)'")
_NO_GLYPH = re.compile(r'No glyph for (".*" \(U\+\w+\))')
_TAIL_SECONDS = 1.0  # to read the rest of the output
_LINES = 400  # of the viewer's output; the line with the reason is followed by the call stack
NO_VULKAN = (
    "The Rerun viewer found no graphics driver: install a software Vulkan driver, "
    "for example: apt install mesa-vulkan-drivers"
)


def find_executable() -> Path:
    """Return the viewer's executable; ending the script ``rerun`` would leave it running."""
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    path = Path(rerun_cli.__file__).parent / name
    if not path.is_file():
        raise VisualizerError(f"The Rerun viewer {path} is missing: reinstall rerun-sdk.")
    return path


def has_display() -> bool:
    """Return whether windows can be opened."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def connect(address: str, timeout: float = 0.5) -> socket.socket | None:
    """Return a connection to the process that listens at ``HOST:PORT``; None if there is none."""
    host, _, port = address.rpartition(":")
    try:
        return socket.create_connection((host.strip("[]"), int(port)), timeout)
    except OSError:
        return None


def is_listening(address: str) -> bool:
    """Return whether a process listens at ``HOST:PORT``."""
    connection = connect(address)
    if connection is None:
        return False
    connection.close()
    return True


def find_free_port() -> int:
    """Return an unused port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _choose_port(port: int) -> int:
    if not port:
        return find_free_port()
    if is_listening(f"127.0.0.1:{port}"):
        raise VisualizerError(
            f"Port {port} is taken: choose another one, or 0 for any free one. If that is a Rerun "
            f'viewer, mode "connect" with address="127.0.0.1:{port}" shows a run in it.'
        )
    return port


class Viewer:
    """A viewer process.

    Attributes:
        address: Address of the viewer, ``127.0.0.1:PORT``.
        page: Its page for browsers, if it was started by `start_web_viewer`.
        process: The process.
    """

    page: str | None = None

    def __init__(
        self,
        port: int,
        options: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        detached: bool = False,
    ) -> None:
        """Start the process.

        Args:
            port: Port of the viewer; 0: any free one.
            options: Further command-line options.
            environment: Environment variables in addition to those of this process.
            detached: Whether the viewer outlives this process.

        Raises:
            VisualizerError: If the port is taken.
        """
        port = _choose_port(port)
        self.address = f"127.0.0.1:{port}"
        self.process = ChildProcess(
            [
                str(find_executable()),
                *("--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"),
                *options,
            ],
            variables={"RERUN_APP_ONLY": "true", **(environment or {})},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL if detached else subprocess.PIPE,
            detached=detached,
        )
        stream = self.process.stderr
        self._tail = None if stream is None else OutputTail(stream, _LINES)

    def wait_until_ready(self, *others: str, timeout: float = 30.0) -> None:
        """Wait until the viewer is listening at its address, and at any others it has."""
        deadline = time.monotonic() + timeout
        while not all(map(is_listening, (self.address, *others))):
            self.check()
            if time.monotonic() > deadline:
                self.end()
                raise VisualizerError(f"The Rerun viewer did not start within {timeout:g} s.")
            time.sleep(0.05)

    def check(self, wait: float = 0.0) -> None:
        """Raise an error if the process has ended.

        Args:
            wait: Time in s to wait for its end.
        """
        status = self.process.wait(wait)
        if status is not None:
            raise VisualizerError(self._describe_end(status))

    def _describe_end(self, status: int) -> str:
        text = "" if self._tail is None else self._tail.text(_TAIL_SECONDS)
        panic = _PANIC.search(text)
        if status == _PANIC_STATUS and (panic is None or "render context" in panic[1]):
            return NO_VULKAN
        if panic is None:
            return f"The Rerun viewer ended with status {status}."
        if glyph := _NO_GLYPH.search(panic[1]):
            return (
                f"The Rerun viewer cannot draw this picture: its font has no glyph for {glyph[1]}. "
                "Use other characters in titles, names and labels."
            )
        return f"The Rerun viewer ended with status {status}: {panic[1]}"

    def end(self) -> None:
        """End the process and wait for it."""
        self.process.close()


def start_web_viewer(port: int, page_port: int, *options: str) -> Viewer:
    """Start a viewer that serves a page to browsers on this machine.

    Args:
        port: Port of the viewer; 0: any free one.
        page_port: Port of the page; 0: any free one.
        options: Further command-line options, and recordings to show.
    """
    page_port = _choose_port(page_port)
    viewer = Viewer(port, ("--serve-web", "--web-viewer-port", str(page_port), *options))
    page = f"127.0.0.1:{page_port}"
    viewer.page = f"http://{page}/?url={quote(f'rerun+http://{viewer.address}/proxy', '')}"
    viewer.wait_until_ready(page)
    return viewer
