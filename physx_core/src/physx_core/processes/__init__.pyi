"""Child processes, threads and temporary folders that end with this process, and its signals."""

from .child import ChildProcess as ChildProcess
from .descendants import children as children
from .descendants import descendants_of as descendants_of
from .descendants import kill_descendants as kill_descendants
from .endings import describe_ending as describe_ending
from .endings import ends_in as ends_in
from .endings import is_ending as is_ending
from .endings import passes_through as passes_through
from .folder import TemporaryFolder as TemporaryFolder
from .helper import Helper as Helper
from .interrupt import Interrupt as Interrupt
from .interrupt import Terminated as Terminated
from .interrupt import deferred_interrupt as deferred_interrupt
from .interrupt import is_from_signal as is_from_signal
from .interrupt import raised_at_sigterm as raised_at_sigterm
from .memory import anonymous_file as anonymous_file
from .tail import OutputFile as OutputFile
from .tail import OutputTail as OutputTail
from .thread import BackgroundThread as BackgroundThread
from .worker import CLIENT_VARIABLE as CLIENT_VARIABLE
from .worker import describe_exit as describe_exit
from .worker import prepare_worker as prepare_worker
from .worker import worker_variables as worker_variables
from .worker_process import WorkerProcess as WorkerProcess
