"""The WebSocket of a live stream: who may listen, what they get, and that a slow one holds nobody up."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.waiting import PATIENCE, wait_until

from egopose.core.errors import InputError
from egopose.inference.stream.broadcast import Broadcast, ServerSettings

pytest.importorskip("websockets")
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

TOKEN = "0123456789abcdef"
SETTINGS: dict[str, Any] = {"host": "127.0.0.1", "port": 0, "token": None, "clients": 2, "queue": 5}


@pytest.fixture
def server() -> Iterator[Broadcast]:
    made = Broadcast(ServerSettings(**SETTINGS), '{"type": "hello"}')
    yield made
    made.close()


def test_each_client_gets_the_form_it_asks_for(server: Broadcast) -> None:
    at = f"ws://127.0.0.1:{server.port}"
    with connect(f"{at}/json") as text, connect(f"{at}/binary") as binary:
        assert json.loads(text.recv(PATIENCE)) == {"type": "hello"}
        assert json.loads(binary.recv(PATIENCE)) == {"type": "hello"}
        wait_until(lambda: server.kinds == {True, False}, "the server has it")
        server.send('{"n": 1}', b"one")
        server.send("status")
        assert [text.recv(PATIENCE), text.recv(PATIENCE)] == ['{"n": 1}', "status"]
        assert [binary.recv(PATIENCE), binary.recv(PATIENCE)] == [b"one", "status"]
    wait_until(lambda: not server.kinds, "the server has it")
    server.send("nobody listens")


@pytest.mark.parametrize(
    ("path", "options", "code"),
    [
        ("/other", {}, 404),
        ("/json", {"origin": "https://elsewhere.example"}, 403),
        ("/json", {"origin": "http://localhost.elsewhere.example"}, 403),
    ],
)
def test_strangers_are_refused(server: Broadcast, path: str, options: dict[str, Any], code: int) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://127.0.0.1:{server.port}{path}", **options)
    assert refused.value.response.status_code == code


def test_a_page_of_this_machine_may_listen(server: Broadcast) -> None:
    with connect(f"ws://127.0.0.1:{server.port}/", origin="http://localhost:8080") as page:
        assert json.loads(page.recv(PATIENCE)) == {"type": "hello"}


def test_more_clients_than_allowed_are_refused(server: Broadcast) -> None:
    at = f"ws://127.0.0.1:{server.port}/json"
    with connect(at) as first, connect(at) as second:
        first.recv(PATIENCE), second.recv(PATIENCE)
        wait_until(lambda: len(server._clients) == 2, "the server has it")
        with pytest.raises(InvalidStatus) as refused:
            connect(at)
        assert refused.value.response.status_code == 503


def test_a_token_is_asked_for() -> None:
    server = Broadcast(ServerSettings(**{**SETTINGS, "token": TOKEN}), "hello")
    at = f"ws://127.0.0.1:{server.port}/json"
    try:
        for wrong in (at, f"{at}?token={TOKEN[:-1]}"):
            with pytest.raises(InvalidStatus) as refused:
                connect(wrong)
            assert refused.value.response.status_code == 401
        with connect(f"{at}?token={TOKEN}") as by_query:
            assert by_query.recv(PATIENCE) == "hello"
        with connect(at, additional_headers={"Authorization": f"Bearer {TOKEN}"}) as by_header:
            assert by_header.recv(PATIENCE) == "hello"
    finally:
        server.close()


def test_a_slow_client_loses_its_oldest_and_nobody_waits(server: Broadcast) -> None:
    payload = np.zeros(100_000, np.uint8).tobytes()
    at = f"ws://127.0.0.1:{server.port}/binary"
    with connect(at, max_queue=1) as slow:
        slow.recv(PATIENCE)
        wait_until(lambda: server.kinds == {True}, "the server has it")
        for number in range(400):  # to the end, though nothing is read meanwhile
            server.send(None, number.to_bytes(4, "little") + payload)
        (client,) = server._clients
        assert len(client.waiting) <= SETTINGS["queue"]
        assert server.dropped > 100
        got = []
        while not got or got[-1] != 399:
            got.append(int.from_bytes(slow.recv(PATIENCE)[:4], "little"))
        assert got == sorted(got)


def test_closing_sends_what_waits(server: Broadcast) -> None:
    other = Broadcast(ServerSettings(**SETTINGS), "hello")
    with connect(f"ws://127.0.0.1:{other.port}/json") as client:
        client.recv(PATIENCE)
        wait_until(lambda: other.kinds == {False}, "the server has it")
        other.send("last")
        other.close()
        assert client.recv(PATIENCE) == "last"
        with pytest.raises(ConnectionClosed):
            client.recv(PATIENCE)


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"cannot listen at 127.0.0.1:{port}"):
            Broadcast(ServerSettings(**{**SETTINGS, "port": port}), "hello")
