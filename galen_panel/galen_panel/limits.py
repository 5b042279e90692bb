"""Limit one address's requests: a flood must not keep the operator from the panel."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

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


class LimitedProtocol(H11Protocol):
    """Serve HTTP by h11, which limits headers, and limit the connections of an address.

    httptools, uvicorn's first choice, has no limit: its time grows with the header's square.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio.Protocol."""
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
    """A client's host; empty where the server does not know it."""
    return client[0] if client else ""
