"""The web server: who may come in, and the page that each browser gets."""

from __future__ import annotations

import os
import signal
import socket
import tempfile
from collections.abc import Callable
from contextlib import closing
from types import FrameType

from galen_model.errors import GalenError

from galen_panel.access import Access
from galen_panel.options import Options
from galen_panel.recordings import Recordings
from galen_panel.suite import Suite


class ServerError(GalenError):
    """The panel can't be served."""


def serve(suite: Suite, options: Options, on_stop: Callable[[], None]) -> None:
    """Serve the panel until SIGINT or SIGTERM; `on_stop` is called when it ends.

    Raises ServerError where the address can't be had.
    """
    _check_address(options)
    # NiceGUI would make a folder for its storage, which the panel doesn't use, in the working
    # directory. It reads this when it is imported.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", tempfile.gettempdir())
    from nicegui import app, ui

    from galen_panel import layout
    from galen_panel.page import Page

    recordings = Recordings(options.bags_dir, options.tools_dir, options.output_dir)
    app.add_middleware(Access, token=options.token, port=options.port)
    app.on_shutdown(recordings.close)
    app.on_shutdown(on_stop)
    recordings.serve(app)

    @ui.page("/", title="Galen")
    def panel() -> None:
        layout.build(Page(suite, options, recordings))

    print(f"panel: open {options.link}", flush=True)
    # uvicorn hands signals on to who had them before, when it has ended.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _ended)
    ui.run(
        host=options.host,
        port=options.port,
        reload=False,
        show=options.show and options.link.split("/", 3)[3] or options.show,
        show_welcome_message=False,
        binding_refresh_interval=None,
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


def _ended(_number: int, _frame: FrameType | None) -> None:
    """A signal is how the panel ends: exit code 0."""


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
