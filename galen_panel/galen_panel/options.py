"""The panel's command line."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

from galen_panel.access import is_loopback, new_token

TOKEN_VARIABLE = "GALEN_PANEL_TOKEN"
_MIN_TOKEN = 16
_EPILOG = f"""\
Where --host is not this machine alone, whoever opens the panel needs its token. It is made anew at
each start and printed with the link; {TOKEN_VARIABLE} in the environment sets it. Without
--certificate what goes through the network can be read there.

Names of topics, services and actions are relative: a namespace is
  panel --ros-args -r __ns:=/left

exit codes:
  0  ended by a signal (Ctrl-C)
  1  can't start: a line says why
  2  wrong arguments"""


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

    @property
    def link(self) -> str:
        """What to open in a browser."""
        scheme = "http" if self.certificate is None else "https"
        host = f"[{self.host}]" if ":" in self.host else self.host
        query = "" if self.token is None else f"?token={self.token}"
        return f"{scheme}://{host}:{self.port}/{query}"


def read_options(arguments: list[str], environment: dict[str, str] | None = None) -> Options:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="panel",
        description="The operator's panel: a page for the browser, served from here.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen at (default: %(default)s, this machine alone; 0.0.0.0: any)",
    )
    parser.add_argument("--port", type=_port, default=8080, help="default: %(default)s")
    parser.add_argument(
        "--bags-dir",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="where recordings are looked for (default: here)",
    )
    parser.add_argument(
        "--tools-dir",
        type=Path,
        default=Path("~/.ros/galen/tools"),
        metavar="DIR",
        help="tools' files that recordings are evaluated with (default: %(default)s)",
    )
    parser.add_argument(
        "--output-dir",
        type=Path,
        default=Path("~/.ros/galen/panel"),
        metavar="DIR",
        help="where reports on recordings are written (default: %(default)s)",
    )
    parser.add_argument("--show", action="store_true", help="open it in this machine's browser")
    parser.add_argument("--certificate", type=Path, metavar="FILE", help="PEM: serve https")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the certificate's key, PEM")
    given = parser.parse_args(arguments)
    if (given.certificate is None) != (given.key is None):
        parser.error("--certificate and --key go together")
    for path in (given.certificate, given.key):
        if path is not None and not path.is_file():
            parser.error(f"{path}: is no file")
    if not given.bags_dir.expanduser().is_dir():
        parser.error(f"--bags-dir {given.bags_dir}: is no directory")
    token = (os.environ if environment is None else environment).get(TOKEN_VARIABLE, "")
    if token and len(token) < _MIN_TOKEN:
        parser.error(f"{TOKEN_VARIABLE} needs {_MIN_TOKEN} characters or more")
    return Options(
        host=given.host,
        port=given.port,
        token=None if is_loopback(given.host) and not token else token or new_token(),
        bags_dir=given.bags_dir.expanduser().resolve(),
        tools_dir=given.tools_dir.expanduser(),
        output_dir=given.output_dir.expanduser(),
        show=given.show,
        certificate=given.certificate,
        key=given.key,
    )


def _port(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"{value} is not in 1 ... 65535")
    return value
