"""What one client may take of the panel: headers, connections, requests under way."""

import asyncio
import socket
from contextlib import ExitStack, closing, suppress

import pytest
from galen_panel.access import MAX_CONNECTIONS, MAX_HEADER_BYTES, MAX_REQUESTS, Turns
from panel_processes import PanelWorld

# One read of the socket may bring this much more.
READ_BYTES = 1 << 18
TIMEOUT_S = 60.0


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("panel")) as world:
        yield int(world.start_panel(fake=True).rstrip("/").rsplit(":")[-1])


def connect(port):
    return socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT_S)


def request(path="/", extra=""):
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n{extra}\r\n".encode()


def status(connection):
    """The answer's status, as text; empty where the connection was closed instead."""
    with suppress(ConnectionError):
        return connection.recv(12).decode()[9:]
    return ""


@pytest.mark.parametrize("start", ["GET / HTTP/1.1\r\nX: ", "GET /", ""])
def test_endless_header_is_not_read_on(port, start):
    """Neither a header, nor an address, nor a method."""
    sent, block = 0, b"x" * 4096
    with closing(connect(port)) as connection, suppress(ConnectionError):
        connection.sendall(start.encode())
        while sent < 4_000_000:
            connection.sendall(block)
            sent += len(block)
        connection.shutdown(socket.SHUT_WR)
        assert status(connection) == "400"
        return
    assert sent >= MAX_HEADER_BYTES - len(block)


def test_many_headers_are_limited_together(port):
    line = f"X-Header: {'x' * 4000}\r\n"
    with closing(connect(port)) as connection:
        # What is too long may be answered by an end of the connection alone.
        with suppress(ConnectionError):
            connection.sendall(request(extra=line * (2 * (MAX_HEADER_BYTES + READ_BYTES) // 4000)))
        assert status(connection) in ("", "400")
    with closing(connect(port)) as connection:
        connection.sendall(request(extra=line * (MAX_HEADER_BYTES // 2 // 4000)))
        assert status(connection) == "200"


def test_requests_of_one_address_under_way_are_limited(port):
    with ExitStack() as stack:
        many = [stack.enter_context(closing(connect(port))) for _ in range(MAX_REQUESTS + 20)]
        for connection in many:
            connection.sendall(request())
        assert status(many[-1]) == "503"


def test_connections_of_one_address_are_limited(port):
    with ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS):
            stack.enter_context(closing(connect(port)))
        with closing(connect(port)) as one_more:
            assert status(one_more) == ""
    # Those are gone: others may come.
    with closing(connect(port)) as connection:
        connection.sendall(request("/favicon.ico"))
        assert status(connection) == "200"


# turns, asked without a server


class App:
    """Begins an answer when `go` is set, and ends it when `end` is."""

    def __init__(self):
        self.asked, self.go, self.end = [], asyncio.Event(), asyncio.Event()

    async def __call__(self, scope, receive, send):
        self.asked.append(scope["path"])
        await self.go.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await self.end.wait()
        await send({"type": "http.response.body", "body": b""})


class Client:
    """One request; `status` is None until an answer begins."""

    def __init__(self, turns, path="/", address="127.0.0.1"):
        self.status, self.given_up = None, False
        scope = {"type": "http", "method": "GET", "path": path, "client": (address, 1)}
        self.task = asyncio.create_task(turns(scope, self._receive, self._send))

    async def _receive(self):
        return {"type": "http.disconnect" if self.given_up else "http.request", "body": b""}

    async def _send(self, message):
        self.status = message.get("status", self.status)


async def until(predicate):
    async with asyncio.timeout(TIMEOUT_S):
        while not predicate():
            await asyncio.sleep(0.001)


def on_turns(story):
    async def told():
        app = App()
        await story(app, Turns(app))

    asyncio.run(told())


def test_one_answer_begins_after_the_other_and_may_take_its_time():
    async def story(app, turns):
        first, second = Client(turns, "/1"), Client(turns, "/2")
        await until(lambda: app.asked == ["/1"])
        assert second.status is None
        app.go.set()
        await until(lambda: second.status == 200)
        assert app.asked == ["/1", "/2"]
        assert not first.task.done() and not second.task.done()

    on_turns(story)


def test_request_that_is_given_up_is_not_answered():
    async def story(app, turns):
        clients = [Client(turns, f"/{k}") for k in range(4)]
        await until(lambda: app.asked)
        clients[1].given_up = clients[2].given_up = True
        app.go.set()
        await until(lambda: clients[3].status == 200)
        assert app.asked == ["/0", "/3"]
        assert clients[1].task.done() and clients[2].task.done()

    on_turns(story)


def test_too_many_requests_of_one_address_are_rejected_until_some_are_answered():
    async def story(app, turns):
        clients = [Client(turns) for _ in range(MAX_REQUESTS)]
        await until(lambda: app.asked)
        one_more = Client(turns)
        other = Client(turns, address="192.0.2.7")
        await until(lambda: one_more.status == 503)
        app.go.set()
        app.end.set()
        await until(lambda: all(client.task.done() for client in [*clients, other]))
        assert {client.status for client in [*clients, other]} == {200}
        again = Client(turns)
        await until(lambda: again.status == 200)

    on_turns(story)


@pytest.mark.parametrize("path", ["/_nicegui_ws/socket.io/", "/_nicegui/3/static/vue.js"])
def test_pages_files_and_sockets_take_no_turn(path):
    async def story(app, turns):
        for _ in range(2 * MAX_REQUESTS):
            Client(turns, path)
        await until(lambda: len(app.asked) == 2 * MAX_REQUESTS)

    on_turns(story)
