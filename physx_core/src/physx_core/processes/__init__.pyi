"""Child processes and temporary folders that go with this process, however it ends."""

from .child import ChildProcess as ChildProcess
from .descendants import kill_descendants as kill_descendants
from .folder import TemporaryFolder as TemporaryFolder
