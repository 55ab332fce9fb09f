"""Interactive play: an environment controlled with the keyboard in real time."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from physx_core.errors import UsageError
from physx_gym.visualization.display import has_display
from physx_gym.visualization.playable import Playable
from physx_gym.visualization.rendering import Renderer

EXIT, PAUSE = "k", "p"
ARROWS = {b"A": "Up", b"B": "Down", b"C": "Right", b"D": "Left"}
_ESCAPE = b"\x1b"


class Keyboard:
    """Keys pressed in a terminal, whose settings are restored when the ``with`` block ends."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Store the terminal.

        Args:
            descriptor: File descriptor of the terminal; None: that of standard input.
        """
        self._given = descriptor
        self._descriptor = -1
        self._before: list[Any] = []
        self._bytes = b""

    def __enter__(self) -> Self:
        """Make the terminal deliver keys immediately."""
        try:
            import termios
            import tty

            self._descriptor = sys.stdin.fileno() if self._given is None else self._given
            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor, termios.TCSANOW)
        except (ImportError, OSError, ValueError, AttributeError) as error:
            raise _terminal_error() from error
        except termios.error as error:
            raise _terminal_error() from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the settings of the terminal."""
        import termios

        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def read(self) -> list[str]:
        """Return the keys pressed since the last call: characters, and `ARROWS`."""
        while select.select([self._descriptor], [], [], 0)[0]:
            read = os.read(self._descriptor, 1024)
            if not read:
                raise EOFError("The terminal was closed.")
            self._bytes += read
        found = []
        while self._bytes:
            size = _length(self._bytes)
            if size == 0:
                break  # the rest of the key has yet to arrive
            key, self._bytes = self._bytes[:size], self._bytes[size:]
            if key[:1] != _ESCAPE:
                found.append(key.decode(errors="replace"))
            elif key[-1:] in ARROWS:
                found.append(ARROWS[key[-1:]])
        return found


def _length(read: bytes) -> int:
    """Return the number of bytes of the first key; 0: it is incomplete."""
    if read[:1] == _ESCAPE:
        if len(read) < 2:
            return 0
        if read[1:2] not in (b"[", b"O"):
            return 1
        ends = (place for place in range(2, len(read)) if 0x40 <= read[place] <= 0x7E)
        return next(ends, -1) + 1
    size = 1 + sum(read[0] >= limit for limit in (0xC0, 0xE0, 0xF0))
    return size if len(read) >= size else 0


def _terminal_error() -> UsageError:
    return UsageError(
        "Playing needs a terminal for keyboard input: run the script in one, on Linux or macOS, "
        "and do not redirect its input."
    )


def play(
    env: Playable,
    enable_travelling: bool | None = None,
    start_paused: bool = True,
    enable_is_done: bool = True,
    verbose: bool = True,
    **kwargs: Any,
) -> None:
    """Play an environment in real time; the key ``k`` quits, ``p`` pauses and resumes.

    All other keys go to `RobotEnv._key_to_action`: characters, ``"Up"``, ``"Down"``, ``"Left"`` and
    ``"Right"``. If there is a display, a viewer shows the robot.

    Args:
        env: The outermost environment of the pipeline; wrappers around it are not used.
        enable_travelling: Whether the viewer's camera follows a robot whose base floats; None: yes.
        start_paused: Whether to start paused.
        enable_is_done: Whether the end of an episode ends the game; otherwise the next one begins.
        verbose: Whether to print what happens.
        kwargs: For `RobotEnv._key_to_action`.
    """
    viewer = _viewer(env, enable_travelling)
    try:
        with Keyboard() as keyboard:
            game = _Game(env, keyboard, viewer, verbose)
            game.run(start_paused, enable_is_done, kwargs)
    finally:
        env.stop()
        if viewer is not None:
            viewer.close()


def _viewer(env: Playable, follow: bool | None) -> Renderer | None:
    """Return a viewer if there is a display; in the mode ``"human"``, the environment has one."""
    if env.render_mode == "human" or not has_display():
        return None
    return Renderer(env.layers[0], mode="human", follow=follow is not False)


class _Game:
    """The loop of keys, steps and pauses."""

    def __init__(
        self, env: Playable, keyboard: Keyboard, viewer: Renderer | None, verbose: bool
    ) -> None:
        self._env, self._keyboard, self._viewer, self._verbose = env, keyboard, viewer, verbose
        owners = (each for each in reversed(env.layers) if hasattr(each, "_key_to_action"))
        self._to_action: Callable[..., Any] = next(owners)._key_to_action
        self._is_paused = False

    def run(self, start_paused: bool, ends: bool, options: dict[str, Any]) -> None:
        """Play until the end."""
        env = self._env
        observation, _ = env.reset()
        reward: float | None = None
        self._is_paused = start_paused
        self._print(f"keys: {EXIT} quits, {PAUSE} {'starts' if start_paused else 'pauses'}")
        self._show()
        due = time.monotonic()
        while True:
            key, is_over = self._read_keys()
            if is_over:
                return
            if not self._is_paused:
                action = self._to_action(key, observation, reward, **options)
                chosen = env.action if action is None else action
                observation, reward, terminated, truncated, _ = env.step(chosen)
                self._show()
                if terminated or truncated:
                    self._print("terminated" if terminated else "truncated")
                    if ends:
                        return
                    (observation, _), reward = env.reset(), None
            due = self._wait(due + env.step_dt)

    def _read_keys(self) -> tuple[str | None, bool]:
        """Return the last key pressed for the robot, and whether the game is over."""
        last = None
        for key in self._keyboard.read():
            if key == EXIT:
                return None, True
            if key == PAUSE:
                self._is_paused = not self._is_paused
                self._print("paused" if self._is_paused else "running")
            else:
                last = key
        return last, False

    def _wait(self, due: float) -> float:
        """Wait until a time; return it, or the current time if that is much later."""
        now = time.monotonic()
        time.sleep(max(0.0, due - now))
        return max(due, now - 0.2)

    def _show(self) -> None:
        if self._viewer is not None:
            self._viewer.frame()

    def _print(self, text: str) -> None:
        if self._verbose:
            print(text, flush=True)  # noqa: T201 - as requested
