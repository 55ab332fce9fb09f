"""An environment that is stepped by datagrams: an action each, answered by the reward."""

import socket

from physx_remote import Protocol, Service


class Datagrams(Protocol):
    name = "datagrams"

    def service(self, worlds, *, address, port):
        return _Service(worlds, address, port)


class _Service(Service):
    def __init__(self, worlds, address, port):
        self._worlds = worlds
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.bind((address, port))
        self.address = self._socket.getsockname()
        worlds.reset(0, seed=1)

    def poll(self, timeout=0.0):
        self._socket.settimeout(timeout or 0.001)
        try:
            action, sender = self._socket.recvfrom(100)
        except TimeoutError:
            return True
        reward = self._worlds.step(0, int(action))[1]
        self._socket.sendto(f"{reward}".encode(), sender)
        return True

    def close(self):
        self._socket.close()
        self._worlds.close()
