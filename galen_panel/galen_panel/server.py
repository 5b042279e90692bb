"""The web server: who may come in, and the page that each browser gets."""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Callable
from contextlib import closing

from galen_model.errors import GalenError

from galen_panel.access import Access
from galen_panel.ending import end_by_signals
from galen_panel.options import Options
from galen_panel.recordings import Recordings
from galen_panel.suite import Suite

RECONNECT_S = 15.0


class ServerError(GalenError):
    """The panel can't be served."""


def serve(suite: Suite, options: Options, on_stop: Callable[[], None]) -> None:
    """Serve the panel until SIGINT or SIGTERM, then exit with code 0; first `on_stop` is called.

    Raises ServerError where the address can't be had, or the certificate not be read.
    """
    end_by_signals()
    _check_address(options)
    _check_certificate(options)
    # NiceGUI looks for what it stored, which the panel doesn't use, in the working directory, where
    # anybody's file could lie. It reads this when it is imported.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(options.output_dir))
    from nicegui import app, ui

    from galen_panel import layout
    from galen_panel.page import Page

    recordings = Recordings(options.bags_dir, options.tools_dir, options.output_dir)
    # NiceGUI adds middleware of its own when it starts, around what was added before; one has
    # browsers keep whatever comes from below /_nicegui, a refusal as well, for a year.
    inner = app.build_middleware_stack
    app.build_middleware_stack = lambda: Access(  # type: ignore[method-assign]
        inner(), options.token, options.port
    )
    app.on_shutdown(recordings.close)
    app.on_shutdown(on_stop)
    recordings.serve(app)

    @ui.page("/", title="Galen")
    def panel() -> None:
        layout.build(Page(suite, options, recordings))

    print(f"panel: open {options.link}", flush=True)
    ui.run(
        host=options.host,
        port=options.port,
        reload=False,
        show=options.place if options.show else False,
        show_welcome_message=False,
        binding_refresh_interval=None,
        # A browser that stands still for longer gets a new page, and has to find its place again.
        reconnect_timeout=RECONNECT_S,
        fastapi_docs=False,
        favicon=_ICON,
        ssl_certfile=None if options.certificate is None else str(options.certificate),
        ssl_keyfile=None if options.key is None else str(options.key),
        timeout_graceful_shutdown=2,
        # Deflating the plots' messages costs more than loopback or a lab's network saves.
        ws_per_message_deflate=False,
    )


_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><rect width="16" height="16"'
    ' rx="3" fill="#10324d"/><path d="M3 12 8 4l5 8" fill="none" stroke="#f5a623"'
    ' stroke-width="2"/></svg>'
)


def _check_address(options: Options) -> None:
    """Say it in a line, before anything is started, where another program has the port."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            options.host, options.port, type=socket.SOCK_STREAM
        )[0]
        with closing(socket.socket(family, kind, protocol)) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except OSError as error:
        raise ServerError(
            f"can't listen at {options.host}, port {options.port}: {error.strerror or error};"
            " --port takes another one"
        ) from error


def _check_certificate(options: Options) -> None:
    """Say it in a line where it, or its key, is none that can be used."""
    if options.certificate is None:
        return
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            options.certificate, options.key, password=lambda: ""
        )
    except (OSError, ValueError) as error:
        raise ServerError(f"can't use {options.certificate} with {options.key}: {error}") from error
