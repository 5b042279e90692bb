# SPDX-License-Identifier: Apache-2.0
"""Who is let in and how much, over plain sockets: browsers can't send what an attacker can."""

import asyncio
import base64
import os
import socket
from contextlib import ExitStack, closing, suppress

import pytest
from galen_panel.access import MAX_CONNECTIONS, MAX_HEADER_BYTES, MAX_REQUESTS, Access, Turns
from galen_panel.options import new_token
from panel_processes import PanelWorld
from starlette.responses import PlainTextResponse

TOKEN = new_token()
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
# One read of the socket may bring this much more.
READ_BYTES = 1 << 18
TIMEOUT_S = 60.0
POLLING = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"


class Server:
    """A panel that answers at a port."""

    def __init__(self, link):
        self.port = int(link.split("/")[2].rsplit(":")[-1])
        self.host = f"127.0.0.1:{self.port}"
        self.cookie = f"galen_panel_{self.port}={TOKEN}"

    def ask(self, path="/", method="GET", host=None, **headers):
        """Return (status, headers, body); names of headers with _ for -; host "": no such line."""
        host = self.host if host is None else host
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        lines = [f"{method} {path} HTTP/1.1"] + ([f"Host: {host}"] if host else [])
        lines += [f"{name}: {value}" for name, value in given.items()]
        if "Upgrade" not in given:
            lines.append("Connection: close")
        with closing(socket.create_connection(("127.0.0.1", self.port), timeout=20)) as connection:
            connection.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
            answer = b""
            while data := connection.recv(65536):
                answer += data
                if answer.startswith(b"HTTP/1.1 101") and b"\r\n\r\n" in answer:
                    break
        head, _, body = answer.partition(b"\r\n\r\n")
        first, *rest = head.decode("latin-1").split("\r\n")
        found = {}
        for one in rest:
            name, _, value = one.partition(":")
            found[name.lower()] = value.strip()
        return int(first.split()[1]), found, body

    def upgrade(self, **headers):
        """Ask for the WebSocket; the status of the answer."""
        key = base64.b64encode(os.urandom(16)).decode()
        status, _, _ = self.ask(
            SOCKET,
            Connection="Upgrade",
            Upgrade="websocket",
            Sec_WebSocket_Version="13",
            Sec_WebSocket_Key=key,
            **headers,
        )
        return status


@pytest.fixture(scope="module")
def open_server(tmp_path_factory):
    """On loopback, without a token."""
    with PanelWorld(tmp_path_factory.mktemp("open")) as world:
        yield Server(world.start_panel(fake=True))


@pytest.fixture(scope="module")
def closed_server(tmp_path_factory):
    """With a token."""
    with PanelWorld(tmp_path_factory.mktemp("closed")) as world:
        yield Server(world.start_panel(fake=True, GALEN_PANEL_TOKEN=TOKEN))


# without a token: this machine's own browser, and its own page


def test_names_of_this_machine_are_let_in(open_server):
    port = open_server.port
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"LOCALHOST:{port}", f"[::1]:{port}"):
        status, _, body = open_server.ask(host=host, Origin=f"http://{host.lower()}")
        assert status == 200 and b"nicegui" in body
        assert open_server.upgrade(host=host, Origin=f"http://{host}") == 101
    # Through an SSH tunnel that has another port here.
    assert open_server.ask(host="localhost:9000", Origin="http://localhost:9000")[0] == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example", "192.0.2.7",
        "0.0.0.0", "[::]", "[::1", "127.0.0.1@evil.example", "",
    ],
)  # fmt: skip
def test_a_name_that_leads_here_by_a_trick_is_not(open_server, host):
    """DNS rebinding: a page of another host whose name now leads to 127.0.0.1."""
    for path in ("/", "/favicon.ico", POLLING):
        status, headers, body = open_server.ask(path, host=host)
        assert status in (400, 403) and b"nicegui" not in body.lower()
        assert "set-cookie" not in headers
    assert open_server.upgrade(host=host, Origin=f"http://{host}") in (400, 403)


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example", "http://127.0.0.1", "http://127.0.0.1:1", "http://localhost:{port}",
        "http://127.0.0.1:{port}@evil.example", "http://evil.example/127.0.0.1:{port}",
        "https://[::1", "null", "", "file://", "127.0.0.1:{port}", "\xe4\xff",
    ],
)  # fmt: skip
def test_a_page_of_another_origin_is_not_let_in(open_server, origin):
    origin = origin.format(port=open_server.port)
    for method in ("GET", "POST", "PUT", "DELETE", "OPTIONS"):
        status, headers, _ = open_server.ask(method=method, Origin=origin)
        assert status == 403 and "access-control-allow-origin" not in headers
    assert open_server.ask(POLLING, Origin=origin)[0] == 403
    assert open_server.upgrade(Origin=origin) == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_what_a_browser_marks_as_of_another_site_may_only_open_a_tab(open_server, site):
    def ask(path="/", **headers):
        return open_server.ask(path, Sec_Fetch_Site=site, **headers)[0]

    assert ask(Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="document") == 200
    assert ask(Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="iframe") == 403
    assert ask(Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="object") == 403
    assert ask("/favicon.ico", Sec_Fetch_Mode="no-cors", Sec_Fetch_Dest="image") == 403
    assert ask(Sec_Fetch_Mode="cors", Sec_Fetch_Dest="empty") == 403
    assert open_server.upgrade(Sec_Fetch_Site=site, Sec_Fetch_Mode="websocket") == 403
    post = {"Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "document", "Content_Length": "0"}
    assert open_server.ask(method="POST", Sec_Fetch_Site=site, **post)[0] == 403


# with a token

PLACES = ("/", "/any/where", "/favicon.ico", "/docs", "/openapi.json", POLLING, "//evil.example/")


def test_without_the_token_nothing_is_told(closed_server):
    _, _, page = closed_server.ask(Cookie=closed_server.cookie)
    static = [word.split('"')[0] for word in page.decode().split('"/_nicegui/')[1:]]
    assert len(static) > 5
    for path in (*PLACES, *(f"/_nicegui/{one}" for one in static)):
        for method in ("GET", "HEAD", "POST", "OPTIONS"):
            status, headers, body = closed_server.ask(path, method=method)
            assert status == 401 and b"nicegui" not in body.lower()
            assert "set-cookie" not in headers and "location" not in headers
            # Else the browser would still show the rejection when it has the token.
            assert headers["cache-control"] == "no-store"
    assert closed_server.upgrade() == 403
    assert closed_server.upgrade(Origin=f"http://{closed_server.host}") == 403


def test_a_wrong_token_is_none(closed_server):
    for token in ("", "x", TOKEN[:-1], TOKEN + "x", TOKEN.swapcase(), "%00", "%ff", "%ED%A0%80"):
        status, headers, _ = closed_server.ask(f"/?token={token}")
        assert status == 401 and "set-cookie" not in headers
        name = closed_server.cookie.split("=")[0]
        assert closed_server.ask(Cookie=f"{name}={token}")[0] == 401
        assert closed_server.upgrade(Cookie=f"{name}={token}") == 403
    other = f"galen_panel_{closed_server.port + 1}={TOKEN}"
    assert closed_server.ask(Cookie=other)[0] == 401
    # The first one counts, and it is not this one.
    assert closed_server.ask(f"/?token=x&token={TOKEN}")[0] == 401


def test_the_token_gives_the_cookie_and_leaves_the_address(closed_server):
    status, headers, _ = closed_server.ask(f"/?tab=live&token={TOKEN}&x=%26")
    assert (status, headers["location"]) == (303, "/?tab=live&x=%26")
    first, *flags = headers["set-cookie"].split("; ")
    assert first == closed_server.cookie
    assert {flag.lower() for flag in flags} == {"httponly", "path=/", "samesite=lax"}
    assert headers["cache-control"] == "no-store" and headers["referrer-policy"] == "no-referrer"


def test_the_cookie_opens_the_page_and_its_socket(closed_server):
    cookie, origin = closed_server.cookie, f"http://{closed_server.host}"
    # Another server of this host may have set cookies of any form.
    for value in (cookie, f'odd={{"a":1}}; {cookie}', f"=; ; a@b=c d; {cookie}; x"):
        status, _, body = closed_server.ask(Cookie=value, Origin=origin)
        assert status == 200 and b"nicegui" in body
        assert closed_server.upgrade(Cookie=value, Origin=origin) == 101
    assert closed_server.upgrade(Cookie=cookie, Origin="http://evil.example") == 403
    assert closed_server.upgrade(Cookie=cookie, Sec_Fetch_Site="same-site") == 403


@pytest.mark.parametrize(
    "path",
    [
        "//evil.example/", "///evil.example", "/%2fevil.example", "/%5c%5cevil.example",
        "/\\evil.example", "/%09/evil.example", "/%0d%0aLocation:%20http://evil.example",
        "/http://evil.example",
    ],
)  # fmt: skip
def test_the_way_to_the_page_never_leads_to_another_host(closed_server, path):
    status, headers, _ = closed_server.ask(f"{path}?token={TOKEN}")
    place = headers["location"]
    assert status == 303 and place.startswith("/")
    assert not place.startswith(("//", "/\\", "/\t"))


def test_a_proxys_headers_change_nothing_but_the_scheme(closed_server):
    _, headers, _ = closed_server.ask(f"/?token={TOKEN}", X_Forwarded_Prefix="//evil.example")
    assert headers["location"] == "/"
    assert closed_server.ask(X_Forwarded_For="127.0.0.1", Forwarded="for=127.0.0.1")[0] == 401
    _, headers, _ = closed_server.ask(f"/?token={TOKEN}", X_Forwarded_Proto="https")
    assert "secure" in headers["set-cookie"].lower()


def test_every_answer_has_the_policy(open_server, closed_server):
    answers = [
        open_server.ask(),
        open_server.ask("/favicon.ico"),
        open_server.ask("/not/there"),
        open_server.ask(Origin="http://evil.example"),
        open_server.ask(host="evil.example"),
        closed_server.ask(),
        closed_server.ask(f"/?token={TOKEN}"),
    ]
    for _, headers, _ in answers:
        policy = headers["content-security-policy"]
        for rule in ("default-src 'self'", "connect-src 'self'", "frame-ancestors 'self'"):
            assert rule in policy
        assert "http" not in policy and "*" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"


def test_an_answer_keeps_a_policy_of_its_own():
    stricter = PlainTextResponse("", headers={"Content-Security-Policy": "sandbox"})
    scope = {"type": "http", "method": "GET", "headers": [(b"host", b"127.0.0.1:8080")]}
    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(Access(stricter, None, 8080)(scope, None, send))
    headers = dict(sent[0]["headers"])
    assert headers[b"content-security-policy"] == b"sandbox"
    assert headers[b"referrer-policy"] == b"no-referrer"


# What one client may take: headers, connections, requests under way


@pytest.fixture(scope="module")
def port(open_server):
    return open_server.port


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


def test_connections_of_one_address_are_limited(port):
    with ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS):
            stack.enter_context(closing(connect(port)))
        with closing(connect(port)) as one_more:
            assert status(one_more) == ""
    # Those are gone: others may come, once what was asked before is answered.
    answer = "503"
    while answer == "503":
        with closing(connect(port)) as connection:
            connection.sendall(request("/favicon.ico"))
            answer = status(connection)
    assert answer == "200"


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
