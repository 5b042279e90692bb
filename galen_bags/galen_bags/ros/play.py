# SPDX-License-Identifier: Apache-2.0
"""`play`: publishes a bag with its own timing, and the time on /clock."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_common.command import (
    EXIT_OK,
    EXIT_SIGNAL,
    ProgressLine,
    add_json,
    make_parser,
    not_negative,
    own_arguments,
    positive,
    print_json,
    run_command,
)
from galen_ros.node.spin import run_until

from galen_bags.formats.bag import Bag, open_bag
from galen_bags.ros.player import PlayerNode, PlayOptions

_NOTES = """Pause: ros2 service call /player/pause std_srvs/srv/SetBool "{data: true}"
Under other names: --ros-args -r OLD:=NEW"""


class PlayRun:
    """One run of the command: the node, the bar on the terminal, what it comes to."""

    def __init__(self, options: argparse.Namespace, bag: Bag) -> None:
        self._options = options
        self._bag = bag
        self._line = ProgressLine()
        self.node: PlayerNode | None = None

    def run(self) -> int | None:
        """Play; returns the number of the signal that ended it, if one did."""
        try:
            return run_until(self._make_node, self._done)
        finally:
            self._line.close()

    def result(self, signal_number: int | None) -> dict[str, Any]:
        """Return what was played, for --json.

        Args:
            signal_number: of the signal that ended it; None: played to the end.

        Returns:
            Counts of messages by topic, times in s, what was left out and why.

        """
        assert self.node is not None
        return {
            "bag": str(self._bag.path),
            "ended_by": "end" if signal_number is None else "signal",
            "messages": sum(self.node.published.values()),
            "topics": self.node.published,
            "left_out": self.node.left_out,
            "position_s": self.node.position_s,
            "wall_s": self.node.played_s,
            "lag_s": self.node.lag_s,
            "acknowledged": self.node.acknowledged,
            "problems": self._bag.problems,
        }

    def summary(self, signal_number: int | None) -> str:
        """Return what was played, for a person.

        Args:
            signal_number: of the signal that ended it; None: played to the end.

        Returns:
            Several lines.

        """
        result = self.result(signal_number)
        lines = [f"{result['bag']}: {result['messages']} messages published"]
        width = max(map(len, result["topics"]))
        lines += [f"  {name:<{width}} {count:>9}" for name, count in result["topics"].items()]
        lines += [f"  {name}: left out: {text}" for name, text in result["left_out"].items()]
        lines += [f"  the bag: {text}" for text in result["problems"]]
        if result["lag_s"] > 0.1:
            lines.append(
                f"  {result['lag_s']:.1f} s late in all: the machine was too slow for this rate"
            )
        if not result["acknowledged"]:
            lines.append("  not all who listen have acknowledged the last messages")
        return "\n".join(lines)

    def _make_node(self) -> PlayerNode:
        options = self._options
        self.node = PlayerNode(
            self._bag,
            PlayOptions(
                topics=tuple(options.topics) if options.topics else None,
                rate=options.rate,
                clock=not options.no_clock,
                start_offset_s=options.start_offset,
                playback_duration_s=options.playback_duration,
                loop=options.loop,
                wait_for_subscribers_s=options.wait_for_subscribers,
            ),
        )
        return self.node

    def _done(self, node: PlayerNode) -> bool:
        if node.state != "waiting":
            self._line.show(lambda: self._progress(node), node.position_s, node.length_s)
        return node.done

    def _progress(self, node: PlayerNode) -> str:
        length = "" if node.length_s is None else f" of {node.length_s:.1f}"
        messages = sum(node.published.values())
        return f"{node.state} {node.position_s:.1f}{length} s, {messages} messages"


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line.

    Args:
        arguments: without the program's name and without those of ROS.

    Returns:
        The options.

    Raises:
        SystemExit: code 2, with a message: the command line is wrong.

    """
    parser = make_parser(
        "play",
        "Publish a bag's messages with its own timing, and its time on /clock.",
        notes=_NOTES,
        ok="played to the end, and all subscribers have acknowledged it",
        failed="the bag can't be read, or has no such topic",
        codes={EXIT_SIGNAL + 15: "ended by SIGTERM"},
    )
    parser.add_argument("bag", type=Path, help="rosbag2 directory, .mcap or .db3")
    parser.add_argument("-r", "--rate", type=positive, default=1.0, help="times as fast")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these of the bag")
    parser.add_argument("--no-clock", action="store_true", help="no /clock with the bag's time")
    parser.add_argument(
        "--start-offset", type=not_negative, default=0.0, metavar="S", help="start so far in"
    )
    parser.add_argument(
        "--playback-duration", type=positive, metavar="S", help="stop after S s of bag time"
    )
    parser.add_argument("-l", "--loop", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument(
        "--wait-for-subscribers",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="wait up to S s until every topic has a subscriber; without it, play starts when no"
        " new subscriber was found for 1 s",
    )
    add_json(parser)
    return parser.parse_args(arguments)


def main() -> int:
    """Run the command; return the exit code. See `play --help`."""
    options = parse(own_arguments(sys.argv[1:]))

    def work() -> int:
        with open_bag(options.bag) as bag:
            replay = PlayRun(options, bag)
            number = replay.run()
            if options.json:
                print_json(replay.result(number))
            else:
                print(replay.summary(number))
        return EXIT_OK if number is None else EXIT_SIGNAL + number

    return run_command("play", work)


if __name__ == "__main__":
    sys.exit(main())
