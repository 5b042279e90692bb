"""Who may talk to the panel: it moves an arm, so that not every web page may.

A page of another host that is open in the same browser could send requests to a server on
loopback, and open its WebSocket: browsers let them. So each request must name this server as its
host (against DNS rebinding) and, where it has one, as its origin; and where the server isn't bound
to loopback it must bring the token, once in the link that the panel prints, from then on in a
cookie that scripts can't read.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

TOKEN_BYTES = 24
_PARAMETER = "token"
_WRONG_TOKEN = (
    "The panel needs its token: open it with the whole link that it printed when it started.\n"
)
# NiceGUI's pages have their scripts inline, and its components are compiled in the browser.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self'"
    " 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self';"
    " worker-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'self';"
    " frame-ancestors 'self'"
)


def is_loopback(host: str) -> bool:
    """Whether a server bound to this host or address is reached from this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def new_token() -> str:
    """A token that can't be guessed, for a link."""
    return secrets.token_urlsafe(TOKEN_BYTES)


class Access:
    """ASGI middleware: lets through what may talk to the panel. token None: loopback only."""

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
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if refusal is None:
            await self._app(scope, receive, _with_policy(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await refusal(scope, receive, send)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if self._token is None and not is_loopback(_hostname(host)):
            return PlainTextResponse("This panel answers on this machine alone.\n", 403)
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return PlainTextResponse("A page of another host may not talk to the panel.\n", 403)
        if self._token is None or self._same(self._cookie_of(headers)):
            return None
        given = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        if scope["type"] == "http" and self._same(given.pop(_PARAMETER, [""])[0]):
            return self._welcome(scope, urlencode(given, doseq=True))
        return PlainTextResponse(_WRONG_TOKEN, 401)

    def _welcome(self, scope: Scope, query: str) -> Response:
        """To the same page, with the cookie and without the token in the address."""
        # A path that begins with two slashes would lead to another host.
        place = "/" + scope["path"].lstrip("/")
        response = RedirectResponse(f"{place}?{query}" if query else place, 303)
        assert self._token is not None
        response.set_cookie(
            self._cookie,
            self._token,
            httponly=True,
            samesite="strict",
            secure=scope.get("scheme") == "https",
        )
        return response

    def _cookie_of(self, headers: Headers) -> str:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return ""
        return cookies[self._cookie].value if self._cookie in cookies else ""

    def _same(self, given: str) -> bool:
        assert self._token is not None
        return hmac.compare_digest(given.encode(), self._token.encode())


def _hostname(netloc: str) -> str:
    try:
        return urlsplit(f"//{netloc}").hostname or ""
    except ValueError:
        return ""


def _with_policy(send: Send) -> Send:
    """The browser may load nothing from another host, and no other host may frame the page."""

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers["Content-Security-Policy"] = _POLICY
            headers["Referrer-Policy"] = "no-referrer"
            headers["X-Content-Type-Options"] = "nosniff"
        await send(message)

    return sent
