"""TLS: encrypts connections between machines; those within one machine stay plain.

A server creates an unsigned certificate for itself. It is trusted because the token proofs in the
handshake cover its fingerprint: a man in the middle has a different certificate, which the proofs
it relays do not match. So there is nothing to install or renew, and one mechanism works with every
Python version. (Pre-shared keys would require Python 3.13 on both sides.)
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import socket
import ssl
import time
from collections.abc import Iterable, Iterator
from typing import Any

from physx_core.net.addresses import is_same_host
from physx_core.processes import anonymous_file

_HANDSHAKE = b"\x16"  # first byte of a client that starts TLS; no frame of a handshake does
CHUNK_SIZE = 1 << 16
_SEND_SIZE = 1 << 17
_SMALL = 1 << 14
_AT_ONCE = getattr(socket, "MSG_DONTWAIT", 0)
_VALID = datetime.timedelta(days=3650)  # not checked by anyone


class Identity:
    """A server's certificate, created when first needed; the key exists only in memory.

    Attributes:
        fingerprint: SHA-256 of the certificate; empty before it is created.
    """

    def __init__(self) -> None:
        """Start without a certificate."""
        self.fingerprint = b""
        self._context: ssl.SSLContext | None = None

    def prepare(self) -> ssl.SSLContext:
        """Return the SSL context for the server's ends of connections."""
        if self._context is None:
            certificate, key, self.fingerprint = _make_certificate()
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.num_tickets = 0  # sessions are never resumed
            with anonymous_file("certificate") as file:
                file.write(key + certificate)
                file.seek(0)
                context.load_cert_chain(f"/dev/fd/{file.fileno()}")
            self._context = context
        return self._context


def _make_certificate() -> tuple[bytes, bytes, bytes]:
    """Return a new certificate and its key as PEM, and the certificate's SHA-256."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "physx")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - _VALID)
        .not_valid_after(now + _VALID)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    return public, private, certificate.fingerprint(hashes.SHA256())


class SecureSocket(socket.socket):
    """An encrypting socket, used like the one that it replaces, blocking or non-blocking.

    As with any non-blocking socket, bytes that `send` did not take must be sent again, starting
    with the same bytes: some of them may already be encrypted.

    Attributes:
        channel: What the token proofs are bound to: the fingerprint of the server's certificate;
            empty if the connection is plain and stays on this machine; None if it is plain and
            comes from elsewhere, or before anything has arrived.
        buffered: Sockets, possibly including this one, that may hold received data that the system
            does not report, because it has already been read for decryption.
    """

    def __init__(self, connected: socket.socket, buffered: set[SecureSocket] | None = None) -> None:
        """Take over a connected socket; see `of_server` and `of_client`.

        Args:
            connected: The socket.
            buffered: The set to use as `buffered`.
        """
        timeout = connected.gettimeout()
        super().__init__(
            connected.family, connected.type, connected.proto, fileno=connected.detach()
        )
        self.settimeout(timeout)
        self.channel: bytes | None = None
        self.buffered = set[SecureSocket]() if buffered is None else buffered
        self._identity: Identity | None = None
        self._is_plain = self._is_broken = False
        self._tls: ssl.SSLObject | None = None
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._unsent = memoryview(b"")  # encrypted
        self._unreported = 0  # bytes that are encrypted but not reported as sent

    @classmethod
    def of_server(
        cls, connected: socket.socket, identity: Identity, buffered: set[SecureSocket]
    ) -> SecureSocket:
        """Return a server's end of a new connection; its first byte decides whether it encrypts.

        Args:
            connected: The connected socket, which is taken over.
            identity: The server's certificate.
            buffered: See the attribute.
        """
        made = cls(connected, buffered)
        made._identity = identity
        return made

    @classmethod
    def of_client(cls, connected: socket.socket) -> SecureSocket:
        """Return a client's end of a connection, encrypted.

        Args:
            connected: The connected, blocking socket, which is taken over. Its timeout covers the
                whole exchange.

        Raises:
            ConnectionAbortedError: If the server does not encrypt.
            OSError: If the connection is broken or the timeout expires.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE  # the proofs of the token verify it
        made = cls(connected)
        try:
            made._tls = context.wrap_bio(made._incoming, made._outgoing)
            made._shake_hands(made._tls)
            certificate = made._tls.getpeercert(binary_form=True) or b""
        except BaseException:
            made.close()
            raise
        made.channel = hashlib.sha256(certificate).digest()
        return made

    def unwrap_if_plain(self) -> socket.socket:
        """Return the socket to use once the peer is trusted: a plain one if not encrypted.

        In that case, this one is detached.
        """
        if not self._is_plain:
            return self
        timeout = self.gettimeout()
        plain = socket.socket(self.family, self.type, self.proto, fileno=self.detach())
        plain.settimeout(timeout)
        return plain

    # As a socket ------------------------------------------------------------------------------

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> int:
        """Receive as many bytes as are available and fit; return their number, 0 at the end.

        Raises:
            OSError: If nothing has arrived, or the connection is broken or was cut.
        """
        tls = self._tls or self._detect_mode()
        if tls is None:
            return super().recv_into(buffer, nbytes, flags)
        if self not in self.buffered:
            self._fetch()
        view = memoryview(buffer).cast("B")
        return self._decrypt(tls, view[: nbytes or len(view)])

    def recv(self, bufsize: int, flags: int = 0) -> bytes:
        """Receive at most `bufsize` bytes: see `recv_into`."""
        buffer = bytearray(bufsize)
        return bytes(buffer[: self.recv_into(buffer, bufsize, flags)])

    def send(self, data: Any, flags: int = 0) -> int:
        """Send as many bytes as the connection takes now; return their number.

        Raises:
            OSError: If the connection takes nothing now or is broken.
        """
        tls = self._tls
        if tls is None:
            return super().send(data, flags)
        view = memoryview(data).cast("B")
        done = 0
        try:
            self._push()
            done, self._unreported = self._unreported, 0
            while done < len(view):
                end = min(done + _SEND_SIZE, len(view))
                while done + self._unreported < end:
                    try:
                        self._unreported += tls.write(view[done + self._unreported : end])
                    except ssl.SSLWantReadError:  # the handshake has not ended
                        self._answer()
                        self._fetch()
                        self.buffered.add(self)
                self._push()
                done, self._unreported = end, 0
        except BlockingIOError:
            if not done:
                raise
        except ssl.SSLError as error:
            raise self._failed(error) from error
        return done

    def sendall(self, data: Any, flags: int = 0) -> None:
        """Send everything."""
        rest = memoryview(data).cast("B")
        while rest:
            rest = rest[self.send(rest, flags) :]

    def sendmsg(self, buffers: Iterable[Any], *rest: Any) -> int:
        """Send parts as one message: see `send`."""
        if self._tls is None:
            return super().sendmsg(buffers, *rest)
        sent = 0
        for block in _blocks(buffers):
            try:
                count = self.send(block)
            except BlockingIOError:
                if not sent:
                    raise
                break
            sent += count
            if count < len(block):
                break
        return sent

    def shutdown(self, how: int) -> None:
        """Shut down the connection; only ``SHUT_WR`` sends a TLS goodbye.

        Hence, any thread may shut down both directions.
        """
        if how == socket.SHUT_WR:
            self._send_close_notify(0)
        super().shutdown(how)

    def close(self) -> None:
        """Send a TLS goodbye, if that does not block, and close the socket."""
        self.buffered.discard(self)
        if self.fileno() >= 0:
            self._send_close_notify(_AT_ONCE)
        super().close()

    # Encryption -------------------------------------------------------------------------------

    def _detect_mode(self) -> ssl.SSLObject | None:
        """Determine from a client's first byte whether it encrypts."""
        if self._is_plain or self._identity is None:
            return None
        first = super().recv(1, socket.MSG_PEEK)
        if first == _HANDSHAKE:
            context = self._identity.prepare()
            self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=True)
            self.channel = self._identity.fingerprint
            return self._tls
        self._is_plain = True
        self.channel = b"" if is_same_host(self) else None
        return None

    def _shake_hands(self, tls: ssl.SSLObject) -> None:
        """Perform a client's TLS handshake within the timeout."""
        patience = self.gettimeout()
        until = None if patience is None else time.monotonic() + patience
        while True:
            try:
                tls.do_handshake()
            except ssl.SSLWantReadError:
                self._push()
                if until is not None:
                    self.settimeout(max(until - time.monotonic(), 1e-3))
                self._fetch()
                continue
            except ssl.SSLError as error:
                raise self._failed(error) from error
            self._push()
            self.settimeout(patience)
            self.buffered.add(self)
            return

    def _decrypt(self, tls: ssl.SSLObject, view: memoryview) -> int:
        """Fill a buffer as far as possible; return the number of bytes, 0 at the end.

        If the buffer is full or the end is near, the socket is added to `buffered`.
        """
        filled, size = 0, len(view)
        while filled < size:
            try:
                count: Any = tls.read(size - filled, view[filled:])
                if not count:  # the peer said goodbye
                    break
                filled += count
            except ssl.SSLWantReadError:
                self.buffered.discard(self)
                self._answer()
                if filled:
                    return filled
                self._fetch()
            except ssl.SSLZeroReturnError:  # the same, after this side said goodbye
                break
            except ssl.SSLError as error:
                if filled:  # the next call raises it again
                    break
                raise self._failed(error) from error
        if filled:
            self.buffered.add(self)
        else:
            self.buffered.discard(self)
        return filled

    def _answer(self) -> None:
        """Send protocol messages of TLS itself, as far as possible now."""
        if self._outgoing.pending:
            with contextlib.suppress(BlockingIOError):
                self._push()

    def _fetch(self) -> None:
        """Read encrypted bytes from the system.

        Raises:
            OSError: If there are none, or the connection is broken.
        """
        if self._is_broken:
            raise ConnectionAbortedError("its encryption has already failed")
        data = super().recv(CHUNK_SIZE)
        if data:
            self._incoming.write(data)
        else:
            self._incoming.write_eof()

    def _push(self) -> None:
        """Pass encrypted bytes to the system.

        Raises:
            BlockingIOError: If it does not take all of them now.
        """
        if self._outgoing.pending:
            new = self._outgoing.read()
            self._unsent = memoryview(bytes(self._unsent) + new if self._unsent else new)
        while self._unsent:
            self._unsent = self._unsent[super().send(self._unsent) :]

    def _failed(self, error: ssl.SSLError) -> OSError:
        """Return the error for a stream that is not TLS, was modified, or lacks a goodbye."""
        self._is_broken = True
        if isinstance(error, ssl.SSLEOFError | ssl.SSLZeroReturnError):
            return ConnectionResetError("it was cut: the peer vanished without closing it")
        reason = (error.reason or str(error)).replace("_", " ").lower()
        return ConnectionAbortedError(f"its encryption failed: {reason}")

    def _send_close_notify(self, flags: int) -> None:
        """Tell the peer that nothing follows, unless earlier data has not been sent completely."""
        tls, is_complete = self._tls, not (self._unsent or self._unreported or self._is_broken)
        if tls is None or not is_complete:
            return
        with contextlib.suppress(OSError, ValueError):
            with contextlib.suppress(ssl.SSLError):  # it would wait for the peer's goodbye
                tls.unwrap()
            super().send(self._outgoing.read(), flags)


def _blocks(parts: Iterable[Any]) -> Iterator[bytes | bytearray | memoryview]:
    """Join small parts, because encryption adds 22 bytes to each piece."""
    joined = bytearray()
    for part in parts:
        view = memoryview(part).cast("B")
        if len(view) < _SMALL:
            joined += view
            continue
        if joined:
            yield joined
            joined = bytearray()
        yield view
    if joined:
        yield joined
