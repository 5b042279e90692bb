# SPDX-License-Identifier: Apache-2.0
"""The panel's command line."""

from __future__ import annotations

import argparse
import ipaddress
import os
import re
import secrets
import socket
from dataclasses import dataclass
from pathlib import Path

from galen_common.command import make_parser
from galen_diagnosis.observation.specification import path_of, presets

from galen_panel.state.snapshot import TOOLS_DIR

TOKEN_VARIABLE = "GALEN_PANEL_TOKEN"
# What needs no quoting in a link or a cookie.
_TOKEN = re.compile(r"[A-Za-z0-9_.~-]{16,}")
_TOKEN_BYTES = 24
_ANY_ADDRESS = ("0.0.0.0", "::")
_NOTES = f"""\
Where --host is not this machine alone, a browser needs the panel's token. It is made anew at
each start and printed with the link; {TOKEN_VARIABLE} in the environment sets it, and has it asked
for on this machine, too. Without --certificate what goes through the network can be read there.

Names of topics, services and actions are relative: a namespace is
  panel --ros-args -r __ns:=/left"""


@dataclass(frozen=True)
class Options:
    """As the command line and the environment say. token None: none is needed."""

    host: str
    port: int
    token: str | None
    bags_dir: Path
    tools_dir: Path
    output_dir: Path
    show: bool
    certificate: Path | None = None
    key: Path | None = None
    specification: tuple[str, ...] = ()

    @property
    def link(self) -> str:
        """What to open in a browser."""
        scheme = "http" if self.certificate is None else "https"
        host = socket.gethostname() if self.host in _ANY_ADDRESS else self.host
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}{self.place}"

    @property
    def place(self) -> str:
        """The link's path, and with it the token."""
        return "/" if self.token is None else f"/?token={self.token}"


def read_options(arguments: list[str], environment: dict[str, str] | None = None) -> Options:
    """Read the command line; exits with code 2 and a message where it is wrong.

    Args:
        arguments: the command's own, without ROS's.
        environment: variables, of which TOKEN_VARIABLE is read; None: the process's.

    Returns:
        The options; with a token made anew where one is needed and none is given.

    """
    parser = make_parser(
        "panel",
        "The operator's panel: a page for the browser, served from here.",
        notes=_NOTES,
        ok="ended by a signal (Ctrl-C)",
        failed="can't start; one line gives the reason",
        interrupted="interrupted (Ctrl-C) before the page was served",
    )
    parser.add_argument(
        "--host",
        type=_host,
        default="127.0.0.1",
        help="address to listen at (default: %(default)s, this machine alone; 0.0.0.0: any)",
    )
    parser.add_argument("--port", type=_port, default=8080, help="default: %(default)s")
    parser.add_argument(
        "--bags-dir",
        type=_path,
        default=".",
        metavar="DIR",
        help="where recordings are looked for (default: here)",
    )
    parser.add_argument(
        "--tools-dir",
        type=_path,
        default=str(TOOLS_DIR),
        metavar="DIR",
        help="calibration files that recordings are evaluated with (default: %(default)s)",
    )
    parser.add_argument(
        "--output-dir",
        type=_path,
        default="~/.ros/galen/panel",
        metavar="DIR",
        help="where reports on recordings are written (default: %(default)s)",
    )
    parser.add_argument(
        "--specification",
        nargs="+",
        default=(),
        metavar="FILE|PRESET",
        help="limits of what is healthy that the page offers first for a diagnosis; as those of"
        " `diagnose` (default: as there)",
    )
    parser.add_argument("--show", action="store_true", help="open it in this machine's browser")
    parser.add_argument("--certificate", type=_path, metavar="FILE", help="PEM: serve https")
    parser.add_argument("--key", type=_path, metavar="FILE", help="the certificate's key, PEM")
    given = parser.parse_args(arguments)
    if (given.certificate is None) != (given.key is None):
        parser.error("--certificate and --key go together")
    for path in (given.certificate, given.key):
        if path is not None and not path.is_file():
            parser.error(f"{path}: is no file")
    if not given.bags_dir.is_dir():
        parser.error(f"--bags-dir {given.bags_dir}: is no directory")
    for one in given.specification:
        if not path_of(one).is_file():
            parser.error(f"--specification {one}: is no file; presets: {', '.join(presets())}")
    token = (os.environ if environment is None else environment).get(TOKEN_VARIABLE, "")
    if token and not _TOKEN.fullmatch(token):
        parser.error(
            f"{TOKEN_VARIABLE} needs 16 characters or more, all of them letters, digits, _ . ~ or -"
        )
    return Options(
        host=given.host,
        port=given.port,
        token=None if is_loopback(given.host) and not token else token or new_token(),
        bags_dir=given.bags_dir.resolve(),
        tools_dir=given.tools_dir,
        output_dir=given.output_dir,
        show=given.show,
        certificate=given.certificate,
        key=given.key,
        specification=tuple(given.specification),
    )


def is_loopback(host: str) -> bool:
    """Return whether a server bound to this host is reached from this machine alone.

    Args:
        host: name or address; an IPv6 address with or without brackets.

    Returns:
        False for what is neither an address nor "localhost".

    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def new_token() -> str:
    """Make a token that can't be guessed, for a link."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def _host(text: str) -> str:
    # NiceGUI takes an empty one for any address.
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty")
    return text


def _port(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is not in 1 ... 65535")
    return int(text)


def _path(text: str) -> Path:
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from error
