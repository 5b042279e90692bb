# SPDX-License-Identifier: Apache-2.0
"""Who may talk to the panel, and how much: it moves an arm, so that not every web page may.

A page of another host that is open in the same browser could send requests to a server on
loopback, and open its WebSocket: browsers let them. So each request must name this server as its
host (against DNS rebinding) and, where it has one, as its origin; what the browser itself marks as
sent by another site may only open the page in a tab. Where the server isn't bound to loopback each
request must bring the token as well: once in the link that the panel prints, from then on in a
cookie that scripts can't read. Limits of one address keep a flood from locking the operator out.
"""

from __future__ import annotations

import asyncio
import hmac
from collections import Counter
from contextlib import AsyncExitStack
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request, cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from galen_panel.options import is_loopback

_PARAMETER = "token"
_WRONG_TOKEN = (
    "The panel needs its token: open it with the whole link that it printed when it started.\n"
)
_OTHER_HOST = "A page of another host may not talk to the panel.\n"
_HEADERS = {
    # NiceGUI's pages have their scripts inline, and its components are compiled in the browser.
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src"
        " 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src"
        " 'self'; worker-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'self';"
        " frame-ancestors 'self'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
MAX_HEADER_BYTES = 1 << 16
"""Of a request's line and headers, beyond what one read of the socket brings (256 kB at most)."""
MAX_CONNECTIONS = 128
"""Of one address. A tab has one for its socket; a browser six at most for all else."""
MAX_REQUESTS = 8
"""For pages and reports, of one address, under way at once; a browser opens a page by one."""
FIRST_REQUEST_S = 20.0
"""A new connection without a whole request is closed after this time."""
# uvloop accepts one connection each time around: a flood's are then all heard between two pages.
_PAUSE_S = 0.02
# NiceGUI's own files and sockets: nothing is built for them, and a socket may stay for hours.
_NO_TURN = "/_nicegui"
_NOT_KEPT = {"Cache-Control": "no-store"}


class Access:
    """ASGI application around another: lets through what may talk to the panel.

    It has to be the outermost, or what is around it changes its rejections. token None: none is
    needed, and only requests that name this machine's loopback as their host are let through.
    """

    def __init__(self, app: ASGIApp, token: str | None, port: int) -> None:
        self._app = app
        self._token = token
        # Browsers keep one cookie of a name for all ports of a host.
        self._cookie = f"galen_panel_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or hand on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        rejection = self._rejection(scope, Headers(scope=scope))
        if rejection is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await rejection(scope, receive, _with_headers(send))

    def _rejection(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if self._token is None and not is_loopback(_part(f"//{host}", "hostname")):
            return _rejected("This panel answers on this machine alone.\n", 403)
        origin = headers.get("origin")
        if origin is not None and _part(origin, "netloc").lower() != host.lower():
            return _rejected(_OTHER_HOST, 403)
        if _of_another_site(headers) and not _opens_a_tab(scope, headers):
            return _rejected(_OTHER_HOST, 403)
        if self._token is None or self._same(self._cookie_of(headers)):
            return None
        given = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        if scope["type"] == "http" and self._same(given.pop(_PARAMETER, [""])[0]):
            return self._welcome(scope, urlencode(given, doseq=True))
        return _rejected(_WRONG_TOKEN, 401)

    def _welcome(self, scope: Scope, query: str) -> Response:
        """To the same page, with the cookie and without the token in the address."""
        # A path that begins with two slashes would lead to another host.
        place = "/" + scope["path"].lstrip("/")
        response = RedirectResponse(
            f"{place}?{query}" if query else place, 303, headers=dict(_NOT_KEPT)
        )
        assert self._token is not None
        response.set_cookie(
            self._cookie,
            self._token,
            httponly=True,
            # Strict cookies don't come with the redirect of a link that another page had.
            samesite="lax",
            secure=scope.get("scheme") == "https",
        )
        return response

    def _cookie_of(self, headers: Headers) -> str:
        # The standard library's parser gives up at the first odd cookie of another server.
        return cookie_parser(headers.get("cookie", "")).get(self._cookie, "")

    def _same(self, given: str) -> bool:
        assert self._token is not None
        return hmac.compare_digest(given.encode(errors="replace"), self._token.encode())


def _rejected(text: str, code: int) -> Response:
    return PlainTextResponse(text, code, headers=dict(_NOT_KEPT))


def _part(address: str, name: str) -> str:
    """Return an address' hostname or netloc; empty where it is none."""
    try:
        return getattr(urlsplit(address), name) or ""
    except ValueError:
        return ""


def _of_another_site(headers: Headers) -> bool:
    """Whether the browser marks it so; some requests of other pages have no Origin."""
    return headers.get("sec-fetch-site") in ("cross-site", "same-site")


def _opens_a_tab(scope: Scope, headers: Headers) -> bool:
    """As by a link on another page; that page can't read what it opened."""
    return (
        scope["type"] == "http"
        and scope["method"] == "GET"
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
    )


def _with_headers(send: Send) -> Send:
    """Add headers: nothing is loaded from another host, and no other host may frame the page.

    An answer that has one of these headers keeps its own: it may be stricter.
    """

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sent


class LimitedProtocol(H11Protocol):
    """Serve HTTP by h11, which limits headers, and limit the connections of an address.

    httptools, uvicorn's first choice, has no limit: its time grows with the header's square.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a new connection, or abort it where its address has MAX_CONNECTIONS already.

        Args:
            transport: see asyncio.Protocol.

        """
        super().connection_made(transport)
        address = _address(self.client)
        count = sum(
            _address(getattr(other, "client", None)) == address for other in self.connections
        )
        if count > MAX_CONNECTIONS:
            transport.abort()
        else:
            self.loop.call_later(FIRST_REQUEST_S, self._close_without_request)

    def _close_without_request(self) -> None:
        # What has become a WebSocket is among the connections as another protocol.
        if self in self.connections and self.cycle is None:
            self.transport.close()


class Turns:
    """ASGI application around another: it begins one answer after the other.

    A page takes some tenths of a second to build. Between two of them the event loop hears what
    open pages ask for, and which requests were given up: those are not answered.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._turn = asyncio.Lock()
        self._under_way: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer when it is this request's turn, or reject one too many of its address."""
        if scope["type"] != "http" or scope["path"].startswith(_NO_TURN):
            await self._app(scope, receive, send)
            return
        address = _address(scope.get("client"))
        if self._under_way[address] >= MAX_REQUESTS:
            await _too_many(address)(scope, receive, send)
            return
        self._under_way[address] += 1
        try:
            await self._answer(scope, receive, send)
        finally:
            self._under_way[address] -= 1
            self._under_way += Counter()  # forgets addresses that have none

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with AsyncExitStack() as turn:
            await turn.enter_async_context(self._turn)
            await asyncio.sleep(_PAUSE_S)
            may_ask = scope["method"] in ("GET", "HEAD")  # else that loses what was sent
            if may_ask and await Request(scope, receive).is_disconnected():
                return

            async def begun(message: Message) -> None:
                # A slow reader takes its time without the others.
                await turn.aclose()
                await send(message)

            await self._app(scope, receive, begun)


def _too_many(address: str) -> PlainTextResponse:
    return PlainTextResponse(
        f"Too many pages for {address} are under way ({MAX_REQUESTS}, the limit):"
        " ask again when they are answered.\n",
        503,
        headers={"Retry-After": "1", "Cache-Control": "no-store"},
    )


def _address(client: Any) -> str:
    return client[0] if client else ""
