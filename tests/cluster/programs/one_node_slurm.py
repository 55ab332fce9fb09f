"""A Slurm cluster of this machine alone, from Debian's packages: munged, slurmctld and slurmd."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import socket
import subprocess
import time
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
CONFIGURATION = """
ClusterName=physx
SlurmctldHost={host}({address})
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1,bf_interval=1,batch_sched_delay=0
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
KillWait=2
MinJobAge={memory}
ReturnToService=2
MpiDefault=none
NodeName={host} NodeAddr={address} CPUs=4 RealMemory=1000 State=UNKNOWN
PartitionName=low Nodes={host} Default=YES PriorityTier=1 MaxTime=60 State=UP
PartitionName=high Nodes={host} PriorityTier=10 MaxTime=60 State=UP
"""


class Slurm:
    """The daemons, with everything that they write in one folder.

    Attributes:
        variables: The environment variable by which Slurm's commands find the cluster.
    """

    def __init__(self, folder: Path, memory: int = 300) -> None:
        """Keep the folder.

        Args:
            folder: Where to put everything; its path must be short, as it is that of a socket.
            memory: How long Slurm remembers jobs that have ended, in s.
        """
        self.folder, self._memory = folder, memory
        self.variables = {"SLURM_CONF": str(folder / "slurm.conf")}
        self._daemons: list[subprocess.Popen[bytes]] = []

    def start(self) -> str:
        """Start the daemons and wait for the node; return why that did not work, if so."""
        missing = [name for name in DAEMONS if shutil.which(name, path=PATH) is None]
        if missing or os.geteuid() != 0:
            return f"Slurm needs root, and {DAEMONS}; not installed: {missing}"
        for name in ("state", "spool"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.folder.chmod(0o755)
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        (self.folder / "slurm.conf").write_text(
            CONFIGURATION.format(
                host=socket.gethostname(),
                address="127.0.0.1",
                ports=free_ports(2),
                folder=self.folder,
                memory=self._memory,
            )
        )
        names = ("key-file", "socket", "pid-file", "log-file", "seed-file")
        files = [f"--{name}={self.folder}/munge.{name.partition('-')[0]}" for name in names]
        self._run("munged", "--foreground", "--force", *files)
        if not wait_for(lambda: (self.folder / "munge.socket").exists()):
            return f"munged does not start: {self._said('munged')}"
        self._run("slurmctld", "-D", "-i")
        self._run("slurmd", "-D")
        if not wait_for(lambda: "idle" in self.ask("sinfo", "--noheader", "--format=%t")):
            return f"Slurm does not start: {self._said('slurmctld')}{self._said('slurmd')}"
        return ""

    def ask(self, *words: str) -> str:
        """Return what one of Slurm's commands prints."""
        done = subprocess.run(
            words,
            env={**os.environ, **self.variables},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.stdout

    def stop(self) -> None:
        """End all jobs and the daemons, if any were started."""
        if not self._daemons:
            return
        self.ask("scancel", "--me", "--quiet")
        wait_for(lambda: not self.ask("squeue", "--noheader"), 15)
        for daemon in reversed(self._daemons):
            daemon.terminate()
        for daemon in reversed(self._daemons):
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
            daemon.wait()

    def _run(self, name: str, *words: str) -> None:
        program = shutil.which(name, path=PATH) or name
        with (self.folder / f"{name}.out").open("wb") as out:
            self._daemons.append(
                subprocess.Popen(
                    [program, *words],
                    env={**os.environ, **self.variables},
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=out,
                    start_new_session=True,
                )
            )

    def _said(self, name: str) -> str:
        return "\n" + (self.folder / f"{name}.out").read_text()[-2000:]


def wait_for(condition, seconds: float = 30.0) -> bool:
    """Wait until a condition is met; return whether it is."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.1)
    return True


def free_ports(count: int) -> list[int]:
    """Return ports that nothing listens at, of those that no connection is given by itself."""
    found: list[int] = []
    while len(found) < count:
        port = random.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as each:
            each.bind(("127.0.0.1", port))
            found += {port}.difference(found)
    return found
