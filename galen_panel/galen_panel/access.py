"""Who may talk to the panel: it moves an arm, so that not every web page may.

A page of another host that is open in the same browser could send requests to a server on
loopback, and open its WebSocket: browsers let them. So each request must name this server as its
host (against DNS rebinding) and, where it has one, as its origin; what the browser itself marks as
sent by another site may only open the page in a tab. Where the server isn't bound to loopback each
request must bring the token as well: once in the link that the panel prints, from then on in a
cookie that scripts can't read.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

TOKEN_BYTES = 24
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
_NOT_KEPT = {"Cache-Control": "no-store"}


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
    """The host's name of an address, or its whole netloc; empty where it is none."""
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
    """The browser may load nothing from another host, and no other host may frame the page.

    An answer that has one of these headers keeps its own: it may be stricter.
    """

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sent
