"""The WebSocket: every client gets every frame it can take; one that is slow loses its oldest."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from egopose.core.errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response


_FIELD = "conf/stream.yaml: server"

# A page of any site may open a socket to this machine's own address; only those that came from it may listen.
_LOCAL_PAGE = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")

_SHORTEST_TOKEN = 16


@dataclass(frozen=True)
class ServerSettings:
    """``server`` of ``conf/stream.yaml``.

    Args:
        host: address to listen at.
        port: None for no server, 0 for any free one.
        token: what clients must know; needed where ``host`` is not this machine alone.
        clients: how many at once.
        queue: messages that wait for a client at most.

    Raises:
        InputError: an address beyond this machine without a token, or a count that is not positive.
    """

    host: str
    port: int | None
    token: str | None
    clients: int
    queue: int

    def __post_init__(self) -> None:
        if min(self.clients, self.queue) < 1:
            raise InputError(_FIELD, "clients, queue", "must be at least 1")
        if self.token is not None and len(self.token) < _SHORTEST_TOKEN:
            raise InputError(_FIELD, "token", f"must have {_SHORTEST_TOKEN} characters or more")
        if self.port is not None and self.token is None and not _is_loopback(self.host):
            cause = f"{self.host} can be reached by others: set EGOPOSE_STREAM_TOKEN to a secret of your own"
            raise InputError(_FIELD, "token", cause)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class _Client:
    """Messages on their way to one client."""

    def __init__(self, binary: bool, room: int) -> None:
        self.binary = binary
        self.waiting: deque[str | bytes] = deque(maxlen=room)
        self.wake = asyncio.Event()
        self.ended = False


class Broadcast:
    """A server on a thread of its own. ``/json`` (and ``/``) sends text alone, ``/binary`` frames in bytes.

    Args:
        settings: see :class:`ServerSettings`; the port is not None.
        greeting: first message to every client.

    Attributes:
        port: listened at.
        dropped: messages that slow clients lost.

    Raises:
        InputError: ``websockets`` is not installed, or the address cannot be listened at.
    """

    def __init__(self, settings: ServerSettings, greeting: str) -> None:
        try:
            import websockets.asyncio.server  # noqa: F401
        except ImportError:
            cause = "needs websockets: pip install 'egopose[stream]', or server.port=null for none"
            raise InputError(_FIELD, "port", cause) from None
        self._settings, self._greeting = settings, greeting
        self._lock = threading.Lock()
        self._clients: set[_Client] = set()
        self._woken = False
        self.dropped, self.port = 0, 0
        self._failed: OSError | None = None
        self._ready = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),), daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failed is not None:
            cause = f"cannot listen at {settings.host}:{settings.port}: {self._failed.strerror}"
            raise InputError(_FIELD, "port", cause)

    @property
    def kinds(self) -> set[bool]:
        """Of the clients: True where one takes bytes, False where one takes text."""
        with self._lock:
            return {client.binary for client in self._clients}

    def send(self, text: str | None = None, binary: bytes | None = None) -> None:
        """To every client the form it takes; text alone goes to all. Never waits."""
        with self._lock:
            for client in self._clients:
                message = binary if client.binary and binary is not None else text
                if message is None:
                    continue
                self.dropped += len(client.waiting) == client.waiting.maxlen
                client.waiting.append(message)
            # One call at most is on its way to the loop, whatever the loop is doing.
            wake = bool(self._clients) and not self._woken
            self._woken = self._woken or wake
        if wake:
            self._loop.call_soon_threadsafe(self._wake)

    def close(self) -> None:
        """Send what waits, then say goodbye to the clients."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        self._loop.close()

    def _wake(self) -> None:
        with self._lock:
            self._woken = False
            clients = list(self._clients)
        for client in clients:
            client.wake.set()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        # Whoever knocks without speaking WebSocket is turned away; that is no fault of the stream, and no news.
        logger = logging.getLogger(f"{__name__}.server")
        logger.setLevel(logging.CRITICAL)
        origins: Iterable[re.Pattern[str] | None] | None = None
        if self._settings.token is None:
            origins = [None, _LOCAL_PAGE]
        try:
            server = await serve(
                self._handle,
                self._settings.host,
                self._settings.port,
                process_request=self._admit,
                origins=origins,  # type: ignore[arg-type]  # Origin is a string of its own kind there
                max_size=1024,
                max_queue=1,
                compression=None,
                close_timeout=2,
                logger=logger,
            )
        except OSError as error:
            self._failed = error
            self._ready.set()
            return
        self.port = next(iter(server.sockets)).getsockname()[1]
        self._ready.set()
        await self._stop.wait()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            client.ended = True
            client.wake.set()
        # Clients that read get what waits for them; the others are cut off.
        for _ in range(20):
            if not self._clients:
                break
            await asyncio.sleep(0.05)
        server.close()
        await server.wait_closed()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """None to go on, else the refusal."""
        address = urlsplit(request.path)
        if address.path not in ("/", "/json", "/binary"):
            return connection.respond(HTTPStatus.NOT_FOUND, "there are /json and /binary\n")
        if self._settings.token is not None:
            given = request.headers.get("Authorization", "").removeprefix("Bearer ")
            given = given or parse_qs(address.query).get("token", [""])[0]
            if not hmac.compare_digest(given.encode(), self._settings.token.encode()):
                return connection.respond(HTTPStatus.UNAUTHORIZED, "wrong or no token\n")
        if len(self._clients) >= self._settings.clients:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many clients\n")
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        assert connection.request is not None
        client = _Client(urlsplit(connection.request.path).path == "/binary", self._settings.queue)
        await connection.send(self._greeting)
        with self._lock:
            self._clients.add(client)
        reader = asyncio.create_task(_until_closed(connection, client))
        try:
            while True:
                await client.wake.wait()
                client.wake.clear()
                while client.waiting:
                    await connection.send(client.waiting.popleft())
                if client.ended:
                    return
        except ConnectionClosed:
            return
        finally:
            with self._lock:
                self._clients.discard(client)
            reader.cancel()


async def _until_closed(connection: ServerConnection, client: _Client) -> None:
    """Nothing a client says matters; but that it leaves must be noticed even while nothing is sent."""
    async for _ in connection:
        pass
    client.ended = True
    client.wake.set()
