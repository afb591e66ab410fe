"""The door before the viewer's server: who may come in, and from which pages.

The server itself listens on a free port of this machine alone and asks nobody anything. The door reads the head of a
connection's first request, refuses it or hands the connection through. On the machine's own address the ``Host`` must
be that address and pages of other sites are refused; on any other address a token is asked for, once in the address
(``/?token=...``) and by a cookie from then on.
"""

from __future__ import annotations

import asyncio
import hmac
import threading
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from egopose.core.errors import InputError

_COOKIE = "egopose_view"
_LOCAL = ("127.0.0.1", "localhost", "::1")
_MAX_HEAD, _PATIENCE = 2**14, 10.0  # bytes and seconds for the head of a request
_SHORTEST_TOKEN = 16


@dataclass(frozen=True)
class Address:
    """Where the viewer listens.

    Raises:
        InputError: an address other than this machine's own without a token, or a token under 16 characters.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    token: str | None = None

    def __post_init__(self) -> None:
        if self.host not in _LOCAL and not self.token:
            cause = f"{self.host} can be reached from elsewhere; give a token, or `--token new` for a fresh one"
            raise InputError("view", "token", cause)
        if self.token is not None and (len(self.token) < _SHORTEST_TOKEN or not self.token.isalnum()):
            raise InputError("view", "token", f"must be letters and digits, {_SHORTEST_TOKEN} at least")


def judge(head: bytes, address: Address) -> bytes | None:
    """None to let the request with this head in, else the answer that refuses it (or sets the cookie).

    Args:
        head: the request's first lines, up to and with the empty one.
        address: what the door stands at.
    """
    first, *lines = head.decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or words[0] != "GET":
        return _answer("405 Method Not Allowed")
    headers = {k.strip().lower(): v.strip() for k, colon, v in (line.partition(":") for line in lines) if colon}
    host, origin = headers.get("host", ""), headers.get("origin")
    if address.host in _LOCAL and (urlsplit(f"//{host}").hostname or "") not in _LOCAL:
        return _answer("403 Forbidden")
    if origin is not None and urlsplit(origin).netloc != host:
        return _answer("403 Forbidden")
    if address.token is None:
        return None
    given = parse_qs(urlsplit(words[1]).query).get("token", [""])[0]
    if given and _same(given, address.token):
        cookie = f"Set-Cookie: {_COOKIE}={address.token}; HttpOnly; SameSite=Strict; Path=/"
        return _answer("303 See Other", "Location: /", cookie)
    try:
        kept = SimpleCookie(headers.get("cookie", "")).get(_COOKIE)
    except CookieError:
        kept = None
    return None if kept is not None and _same(kept.value, address.token) else _answer("403 Forbidden")


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode())


def _answer(status: str, *headers: str) -> bytes:
    body = f"{status}: open the address that `egopose view` printed.\n"
    fixed = ["Content-Type: text/plain", f"Content-Length: {len(body)}", "Connection: close"]
    return "\r\n".join([f"HTTP/1.1 {status}", *headers, *fixed, "", body]).encode()


class AuthProxy:
    """Listens at ``address`` and leads to the port ``behind`` of this machine, on a thread of its own.

    Raises:
        InputError: the address cannot be listened at.
    """

    def __init__(self, address: Address, behind: int) -> None:
        self._address, self._behind = address, behind
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._ready = threading.Event()
        self._fault: OSError | None = None
        self.port = address.port
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._serve()), daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._fault is not None:
            place = f"{address.host}:{address.port}"
            raise InputError("view", "port", f"cannot listen at {place}: {self._fault.strerror}; give another --port")

    async def _serve(self) -> None:
        try:
            server = await asyncio.start_server(self._enter, self._address.host, self._address.port, limit=_MAX_HEAD)
        except OSError as error:
            self._fault = error
            self._ready.set()
            return
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        await self._stop.wait()
        server.close()
        open_ways = asyncio.all_tasks() - {asyncio.current_task()}
        for task in open_ways:
            task.cancel()
        await asyncio.gather(*open_ways, return_exceptions=True)

    async def _enter(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _PATIENCE)
            refusal = judge(head, self._address)
            if refusal is not None:
                writer.write(refusal)
                await writer.drain()
                return
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._behind)
            try:
                inner_writer.write(head)
                ways = [
                    asyncio.create_task(_carry(reader, inner_writer)),
                    asyncio.create_task(_carry(inner_reader, writer)),
                ]
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in ways:
                    way.cancel()
            finally:
                inner_writer.close()
        except (TimeoutError, OSError, ValueError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            return  # whoever knocked went away, or spoke no HTTP
        except asyncio.CancelledError:
            return  # the door closes; asyncio would print a traceback for each browser that is still there
        finally:
            writer.close()

    def close(self) -> None:
        """Listen no more."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(timeout=2.0)


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(2**16):
        writer.write(data)
        await writer.drain()
