"""`panel`: the operator's panel in the browser, a client of the suite's nodes like any other."""

from __future__ import annotations

import sys

from galen_panel.ending import end_by_signals


def main() -> None:
    """Run the panel; see `panel --help`."""
    # Before the slow imports: an early signal, too, is an orderly end.
    end_by_signals()
    from galen_model.errors import GalenError
    from galen_ros.node.spin import own_arguments

    from galen_panel.options import read_options

    options = read_options(own_arguments(sys.argv)[1:])
    # Slower still, and nothing of it is needed for --help.
    from galen_panel.ros.suite import RosSuite
    from galen_panel.server import serve

    try:
        with RosSuite(sys.argv) as suite:
            serve(suite, options, suite.close)
    except GalenError as error:
        print(f"panel: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
