# SPDX-License-Identifier: Apache-2.0
"""The web server: who may come in, and the page that each browser gets."""

from __future__ import annotations

import errno
import os
import socket
import ssl
from collections.abc import Awaitable, Callable
from contextlib import closing
from typing import TYPE_CHECKING

from galen_common.command import check_folder
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from galen_panel.access import MAX_HEADER_BYTES, Access, LimitedProtocol, Turns
from galen_panel.options import Options
from galen_panel.panel import end_by_signals, end_server, ignore_signals
from galen_panel.recordings.recordings import Recordings
from galen_panel.state.shapes import MESHES_PATH

if TYPE_CHECKING:
    from galen_panel.ros.suite import RosSuite

RECONNECT_S = 15.0
# A page whose panel says nothing for the sum of both shows that its connection is lost.
_PING_S = 2.0
_PONG_WITHIN_S = 4.0
# A mesh's name is made of its content.
_KEPT = {"Cache-Control": "private, max-age=31536000, immutable"}


def serve(suite: RosSuite, options: Options, on_stop: Callable[[], None]) -> None:
    """Serve the panel until SIGINT or SIGTERM.

    Args:
        suite: what the pages show and ask.
        options: of the command line.
        on_stop: called at the end.

    Raises:
        GalenError: the address can't be had, the certificate can't be used, or no report can be
            written into the output directory.

    """
    end_by_signals()
    _check_address(options)
    _check_certificate(options)
    _check_output_dir(options)
    # NiceGUI looks for what it stored, which the panel doesn't use, in the working directory, where
    # anybody's file could lie. It reads this when it is imported.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(options.output_dir))
    from nicegui import app, core, ui
    from nicegui.server import Server

    from galen_panel.page import layout
    from galen_panel.page.page import Page

    def arm() -> Arm:
        return suite.state.drawing.arm if suite.state.drawing else GALEN

    recordings = Recordings(
        options.bags_dir, options.tools_dir, options.output_dir, arm, options.specification
    )
    # NiceGUI adds middleware of its own when it starts, around what was added before; one has
    # browsers keep whatever comes from below /_nicegui, a rejection as well, for a year.
    inner = app.build_middleware_stack
    app.build_middleware_stack = lambda: Access(  # type: ignore[method-assign]
        Turns(inner()), options.token, options.port
    )

    def ping_often() -> None:
        # NiceGUI sets them by its reconnect_timeout when it starts, to three times as long.
        core.sio.eio.ping_interval, core.sio.eio.ping_timeout = _PING_S, _PONG_WITHIN_S

    app.on_startup(ping_often)
    app.on_shutdown(recordings.jobs.close)
    app.on_shutdown(on_stop)
    recordings.reports.serve(app)
    app.add_route(f"{MESHES_PATH}/{{name}}", mesh_answer(suite), methods=["GET"])

    @ui.page("/", title="Galen")
    def panel() -> None:
        layout.build(Page(suite, recordings))

    Server.handle_exit = end_server  # type: ignore[assignment,method-assign]
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
        http=LimitedProtocol,
        h11_max_incomplete_event_size=MAX_HEADER_BYTES,
        # Deflating the plots' messages costs more than loopback or a lab's network saves.
        ws_per_message_deflate=False,
    )
    ignore_signals()


def mesh_answer(suite: RosSuite) -> Callable[[Request], Awaitable[Response]]:
    """Make the route of the present arm's meshes; no path is made of what a browser asks for.

    Args:
        suite: with the arm's drawing.

    Returns:
        The route's handler: binary STL by the mesh's name, or 404.

    """

    async def answer(request: Request) -> Response:
        drawing = suite.state.drawing
        content = drawing and drawing.meshes.get(request.path_params["name"])
        if not content:
            return PlainTextResponse("There is no such mesh.\n", 404)
        return Response(content, media_type="model/stl", headers=_KEPT)

    return answer


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
        wrong = "port" if error.errno in (errno.EADDRINUSE, errno.EACCES) else "host"
        raise GalenError(
            f"can't listen at {options.host}, port {options.port}: {error.strerror or error};"
            f" choose another {wrong} by --{wrong}, in a launch by panel_{wrong}:="
        ) from error


def _check_output_dir(options: Options) -> None:
    """Say it in a line where no report could be written there."""
    try:
        check_folder(options.output_dir)
    except GalenError as error:
        raise GalenError(f"{error}; choose another directory by --output-dir") from error


def _check_certificate(options: Options) -> None:
    """Say it in a line where it, or its key, is none that can be used."""
    if options.certificate is None:
        return
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            options.certificate, options.key, password=lambda: ""
        )
    except (OSError, ValueError) as error:
        raise GalenError(f"can't use {options.certificate} with {options.key}: {error}") from error
