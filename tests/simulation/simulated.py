"""A network, a clock, and clients within one thread: the order of all events is a test's choice.

The test's own code and each client are greenlets: one runs until it waits, and then whatever can
happen next is up to `Simulation.choose`: bytes arrive, another one goes on, or time passes.
"""

from __future__ import annotations

import asyncio
import errno
import math
import select
import selectors
import signal
import socket
import struct
from functools import partial

from greenlet import GreenletExit, getcurrent, greenlet
from hypothesis import strategies as st

from physx_core import Launcher
from physx_core.components.launcher import ClientHandle
from physx_core.net import Transport
from physx_core.workers.client.joining import join
from physx_core.workers.client.link import RunEnded
from physx_core.workers.client.worker import run_instance

ROOM = 1 << 22
SHORT = 1e-3  # s that pass if time is chosen to pass
HOST = "127.0.0.1"


CHOICES = 200  # that are drawn; after them the first event is always the next


def choosing(numbers):
    """Return a function that chooses one of some events by the next of these numbers."""
    rest = iter(numbers)
    return lambda count: next(rest, 0) % count


drawn = st.lists(st.integers(0, 11), min_size=CHOICES, max_size=CHOICES).map(choosing)
"""Orders of events."""


class Deadlock(Exception):
    """Everybody waits for something that cannot happen."""


class Simulation(Transport):
    """A network that is its own clock; time passes when everybody waits.

    Attributes:
        clients: Those that were started, in order.
        plan: Functions to call before an event, by the number of that event.
        events: How many there were.
        current: The simulation that the launcher and environments are in.
    """

    current = None

    def __init__(self, choose=lambda count: 0, room=ROOM):
        """Start at an arbitrary time.

        Args:
            choose: Takes a number of possible events; returns the index of the next one.
            room: How many bytes a link takes before they are read.
        """
        self.clock, self.choose, self.room = self, choose, room
        self.clients, self.plan, self.events = [], {}, 0
        self._now, self._links, self._listening = 1000.0, [], {}
        self._tasks = [Task(self, getcurrent())]
        self._hub = greenlet(self._run)

    def __enter__(self):
        Simulation.current = self
        return self

    def __exit__(self, *_):
        """End what still runs."""
        Simulation.current = None
        self.choose = lambda count: 0
        for task in self._tasks[1:]:
            task.abandon()

    # Clock ----------------------------------------------------------------------------------

    def monotonic(self):
        return self._now

    def sleep(self, seconds):
        self.wait(lambda: False, seconds)

    def spin_until(self, look, seconds):
        return look()

    def wait(self, is_ready, seconds=None):
        """Let others go on until this one is ready, or a time in s has passed; return whether."""
        current = getcurrent()
        (task,) = [task for task in self._tasks if task.greenlet is current]
        task.wait(is_ready, math.inf if seconds is None else self._now + seconds)
        if self._hub.dead:
            self._hub = greenlet(self._run)
        self._hub.parent = self._tasks[0].greenlet
        loop = asyncio._get_running_loop()  # of this one; a thread has only one
        asyncio._set_running_loop(None)
        try:
            self._hub.switch()
        finally:
            asyncio._set_running_loop(loop)
        if task.is_killed:
            raise GreenletExit
        return bool(is_ready())

    def _run(self):
        try:
            while True:
                self._next()()
        except BaseException:
            self.choose = lambda count: 0
            raise

    def _next(self):
        self.events += 1
        if planned := self.plan.pop(self.events, None):
            return planned
        found = [link.deliver for link in self._links if link.has_news]
        waiting = sorted((task for task in self._tasks if task.is_due), key=lambda task: task.ran)
        found += [task.resume for task in waiting]
        if found:
            found.append(partial(self._pass_time, self._now + SHORT))
            return found[self.choose(len(found))]
        until = min(task.until for task in self._tasks if task.goes_on)
        if until == math.inf:
            raise Deadlock
        return partial(self._pass_time, until)

    def _pass_time(self, until):
        self._now = max(self._now, until)

    # Transport -----------------------------------------------------------------------------

    def listen(self, address, port):
        port = port or 1 + len(self._listening)
        self._listening[port] = listening = Listening(self, port)
        return listening

    def connect(self, address, timeout, *, unread=None):
        self.wait(lambda: True)
        listening = self._listening.get(address[1])
        if listening is None or listening.is_closed:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
        near, far = self.pair()
        near.address, far.address = (HOST, address[1]), (HOST, 50000 + len(self._links))
        listening.waiting.append((far, far.address))
        near.settimeout(timeout)
        return near

    def pair(self):
        one, other = Link(self), Link(self)
        one.peer, other.peer = other, one
        self._links += [one, other]
        return one, other

    def selector(self):
        return Selector(self)

    def poll(self, link, events=select.POLLIN):
        return Poll(self, link, events)

    # Clients --------------------------------------------------------------------------------

    @property
    def alive(self):
        """The clients that have not ended, by the numbers of their instances."""
        return {client.instance_id: client for client in self.clients if client.is_alive}

    @property
    def running(self):
        """The client that runs now."""
        (found,) = [client for client in self.clients if client.is_running]
        return found

    def start_client(self, instance, address, token, **options):
        client = Client(self, instance, address, token, **options)
        self.clients.append(client)
        return client

    def start(self, run):
        """Run a function beside the test."""
        task = Task(self, greenlet(run))
        task.wait(lambda: True)
        self._tasks.append(task)
        return task


class SimulatedLauncher(Launcher):
    """Starts clients in the current simulation."""

    def launch(self, instances, address, token):
        current = Simulation.current
        return [current.start_client(number, address, token) for number in instances]


class Task:
    """What runs beside others.

    Attributes:
        until: When it stops waiting.
        ran: The number of the event at which it last went on.
        is_killed: Whether it never goes on.
        is_stopped: Whether it does not go on for now.
    """

    def __init__(self, simulation, running):
        self.greenlet, self._simulation = running, simulation
        self.until, self.ran, self.is_killed, self.is_stopped = math.inf, 0, False, False

    @property
    def goes_on(self):
        return not (self.greenlet.dead or self.is_killed or self.is_stopped)

    @property
    def is_due(self):
        if not self.goes_on:
            return False
        return self.until <= self._simulation.monotonic() or bool(self._is_ready())

    def wait(self, is_ready, until=math.inf):
        self._is_ready, self.until = is_ready, until

    def resume(self):
        self.ran, self.until = self._simulation.events, math.inf
        if self.greenlet.parent is not None:
            self.greenlet.parent = getcurrent()
        self.greenlet.switch()

    def kill(self):
        self.is_killed = True

    def abandon(self):
        """Leave all its calls."""
        self.kill()
        self.greenlet.parent = getcurrent()
        self.greenlet.throw(GreenletExit)


class Client(ClientHandle):
    """A client that runs one instance beside the test."""

    def __init__(self, simulation, instance, address, token):
        self.instance_id, self.clock = instance, simulation
        self.link = None
        self._arguments = (address, token, instance)
        self._status = self.error = None
        self._task = simulation.start(self._run)

    def _run(self):
        try:
            self.link, setup = join(*self._arguments, transport=self.clock)
            try:
                del setup["path"], setup["directory"], setup["heartbeat"]
                self._status = run_instance(self.link, setup)
            finally:
                self.link.close()
        except RunEnded:
            self._status = 1
        except SystemExit as error:
            self._status = error.code
        except Exception as error:
            self._status, self.error = 1, error

    @property
    def is_alive(self):
        return self._status is None

    @property
    def is_running(self):
        return self._task.greenlet is getcurrent()

    def exit_status(self):
        return self._status

    def terminate(self):
        self.end(signal.SIGTERM)

    def kill(self):
        self.end(signal.SIGKILL)

    def end(self, number):
        """End as by a signal: the system closes its link."""
        self.leave(-number)

    def leave(self, status):
        """End with an exit status, as by `os._exit`."""
        if self._status is None:
            self._status = status
            self._task.kill()
            if self.link is not None:
                self.link.close()

    def stop(self):
        """Stop as by SIGSTOP."""
        self._task.is_stopped = True

    def vanish(self):
        """Be lost with the machine: nothing arrives any more, not even an end."""
        self._task.kill()
        self.link._connection.unplug()


class Link:
    """One end of a connection in memory; it behaves like that of a Unix socket.

    Attributes:
        peer: The other end.
        address: The address of the peer.
    """

    address = ""
    family = socket.AF_UNIX

    def __init__(self, simulation):
        self._simulation, self._timeout = simulation, None
        self._coming, self._arrived = bytearray(), bytearray()
        self._end_comes = self._has_ended = self._is_closed = False
        self._unplugged = math.inf

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @property
    def has_news(self):
        """Whether something can arrive."""
        return self._unplugged == math.inf and (
            bool(self._coming) or (self._end_comes and not self._has_ended)
        )

    def deliver(self):
        """Let all or some of what was sent arrive."""
        size = len(self._coming)
        if not size:
            self._has_ended = True
            return
        count = (size, 1, (size + 1) // 2)[self._simulation.choose(3 if size > 1 else 1)]
        self._arrived += self._coming[:count]
        del self._coming[:count]

    def unplug(self):
        self._unplugged = self.peer._unplugged = self._simulation.monotonic()

    @property
    def is_readable(self):
        return bool(self._arrived) or self._has_ended or self._is_closed

    @property
    def has_ended(self):
        return self._has_ended

    @property
    def is_writable(self):
        return self._room > 0 or self.peer._is_closed or self._is_closed

    @property
    def _room(self):
        return self._simulation.room - len(self.peer._coming) - len(self.peer._arrived)

    def _block(self, is_ready):
        if self._timeout == 0:
            if not is_ready():
                raise BlockingIOError
        elif not self._simulation.wait(is_ready, self._timeout):
            raise TimeoutError("timed out")

    def recv_into(self, buffer):
        self._block(lambda: self.is_readable)
        if self._is_closed:
            raise OSError(errno.EBADF, "Bad file descriptor")
        view = memoryview(buffer).cast("B")
        count = min(len(view), len(self._arrived))
        view[:count] = self._arrived[:count]
        del self._arrived[:count]
        return count

    def recv(self, size):
        buffer = bytearray(size)
        return bytes(buffer[: self.recv_into(buffer)])

    def send(self, data):
        self._block(lambda: self.is_writable)
        if self.peer._is_closed or self._is_closed:
            raise ConnectionResetError(errno.ECONNRESET, "Connection reset by peer")
        part = bytes(memoryview(data).cast("B")[: self._room])
        self.peer._coming += part
        return len(part)

    def sendmsg(self, parts):
        return self.send(b"".join(bytes(memoryview(part).cast("B")) for part in parts))

    def sendall(self, data):
        rest = memoryview(data).cast("B")
        while rest:
            rest = rest[self.send(rest) :]

    def shutdown(self, how):
        self.peer._end_comes = True
        if how == socket.SHUT_RDWR:
            self._has_ended = True

    def close(self):
        self._is_closed = self.peer._end_comes = True

    def fileno(self):
        return -1

    def getpeername(self):
        return self.address

    def settimeout(self, seconds):
        self._timeout = seconds

    def gettimeout(self):
        return self._timeout

    def setblocking(self, flag):
        self._timeout = None if flag else 0

    def setsockopt(self, level, option, value):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    def getsockopt(self, level, option, size):
        silence = self._simulation.monotonic() - self._unplugged
        if silence < 0:
            raise OSError(errno.EOPNOTSUPP, "Operation not supported")
        silences = [int(1000 * silence)] * 2  # as in Linux's tcp_info
        return struct.pack("=8B13I", 0, 0, 2, *[0] * 16, *silences)


class Listening:
    """What accepts connections; `waiting` have not been accepted."""

    def __init__(self, simulation, port):
        self.waiting, self.is_closed, self._port = [], False, port

    @property
    def is_readable(self):
        return bool(self.waiting)

    is_writable = False

    def accept(self):
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.pop(0)

    def getsockname(self):
        return HOST, self._port

    def setblocking(self, flag):
        """Do nothing: it never blocks."""

    def fileno(self):
        return -1

    def close(self):
        self.is_closed = True
        for link, _ in self.waiting:
            link.close()


class Selector:
    """A selector of links."""

    def __init__(self, simulation):
        self._simulation, self._keys = simulation, {}

    def register(self, link, events, data=None):
        self._keys[link] = selectors.SelectorKey(link, -1, events, data)

    modify = register

    def unregister(self, link):
        del self._keys[link]

    def get_map(self):
        return self._keys

    def select(self, timeout=None):
        self._simulation.wait(self._find, timeout)
        return self._find()

    def _find(self):
        found = []
        for key in self._keys.values():
            events = selectors.EVENT_READ * key.fileobj.is_readable
            events |= selectors.EVENT_WRITE * key.fileobj.is_writable
            if events & key.events:
                found.append((key, events & key.events))
        return found

    def close(self):
        self._keys.clear()


class Poll:
    """Watches one link."""

    def __init__(self, simulation, link, events):
        self._simulation, self._link, self._events = simulation, link, events

    def poll(self, milliseconds=None):
        seconds = None if milliseconds is None else milliseconds / 1000
        self._simulation.wait(self._find, seconds)
        return self._find()

    def _find(self):
        found = self._events & (
            select.POLLIN * self._link.is_readable
            | select.POLLOUT * self._link.is_writable
            | select.POLLRDHUP * self._link.has_ended
        )
        return [(-1, found)] if found else []
