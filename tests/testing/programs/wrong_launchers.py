"""Launchers with mistakes that their names tell, and one that has none."""

import contextlib
import os
import signal
import subprocess
import sys

from physx_core import ClientHandle, Launcher


class Handle(ClientHandle):
    session = True

    def __init__(self, instance_id, address, token, folder):
        self.instance_id = instance_id
        self.path = folder / f"{instance_id}.{os.urandom(4).hex()}"
        with self.path.open("wb") as file:
            self.process = subprocess.Popen(
                self.command(address, token),
                env={**os.environ, "PHYSX_TOKEN": token},
                stderr=file,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def command(self, address, token):
        words = [sys.executable, "-P", "-m", "physx_core.workers", "--connect", address]
        return [*words, "--instance", str(self.instance_id)]

    def exit_status(self):
        status = self.process.poll()
        if status is not None:
            self.signal(signal.SIGKILL)
        return status

    def signal(self, number):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def terminate(self):
        self.signal(signal.SIGTERM)

    def kill(self):
        self.signal(signal.SIGKILL)

    def stderr(self):
        return self.path.read_text()


class Right(Launcher):
    handle = Handle

    def open(self):
        import tempfile
        from pathlib import Path

        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name)
        self.started = []

    def launch(self, instances, address, token):
        made = [self.handle(number, address, token, self.path) for number in instances]
        self.started += made
        return made

    def close(self):
        self.folder.cleanup()


class Careless(Right):
    """Shows the token, forgets last words, starts clients backwards, and none a second time."""

    class handle(Handle):
        def command(self, address, token):
            return ["/bin/sh", "-c", '"$@" & wait $!', token, *super().command(address, token)]

        def stderr(self):
            return ""

    def launch(self, instances, address, token):
        if self.started:
            raise OSError("out of machines")
        return super().launch(instances, address, token)[::-1]


class Ruthless(Right):
    """Kills all clients for one, and takes every end for a good one."""

    class handle(Handle):
        def exit_status(self):
            return None if super().exit_status() is None else 0

    def launch(self, instances, address, token):
        made = super().launch(instances, address, token)
        for handle in made:
            handle.kill = lambda: [Handle.kill(each) for each in self.started]
        return made


class LeavesChildren(Right):
    class handle(Handle):
        def signal(self, number):
            if self.process.returncode is None:
                self.process.send_signal(number)
