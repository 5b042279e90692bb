"""`play`: publishes a bag with its own timing, and the time on /clock."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_OK,
    EXIT_SIGNAL,
    ProgressLine,
    add_json,
    make_parser,
    not_negative,
    positive,
    split_ros_arguments,
)
from galen_ros.node.spin import run_until

from galen_bags.errors import BagError
from galen_bags.formats.bag import Bag, open_bag
from galen_bags.play.player import PlayerNode, PlayOptions
from galen_bags.topics import check_topic_name

_NOTES = 'Pause: ros2 service call /player/pause std_srvs/srv/SetBool "{data: true}"'


class Replay:
    """One run of the command: the node, the bar on the terminal, what it comes to."""

    def __init__(self, options: argparse.Namespace, bag: Bag, ros: Sequence[str]) -> None:
        self._options = options
        self._ros_arguments = list(ros)
        self._bag = bag
        self._line = ProgressLine()
        self.node: PlayerNode | None = None

    def run(self) -> int | None:
        """Play; returns the number of the signal that ended it, if one did."""
        arguments = [*self._ros_arguments, "--ros-args"]
        arguments += [part for rule in self._options.remap or [] for part in ("-r", rule)]
        try:
            return run_until(self._make_node, self._done, arguments)
        finally:
            self._line.close()

    def result(self, signal_number: int | None) -> dict[str, Any]:
        """Return what was played, for --json."""
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
        """Return what was played, for a person."""
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
                clock_hz=0.0 if options.no_clock else options.clock,
                start_offset_s=options.start_offset,
                playback_duration_s=options.playback_duration,
                loop=options.loop,
                start_paused=options.start_paused,
                delay_s=options.delay,
                wait_for_subscribers_s=options.wait_for_subscribers,
                log_stamps=options.stamps == "log",
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
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = make_parser(
        "play",
        "Publish a bag's messages with its own timing, and its time on /clock.",
        notes=_NOTES,
        ok="played to the end, and all subscribers have acknowledged it",
        failed="the bag can't be read, or has no such topic",
        codes={EXIT_SIGNAL + 15: "ended by SIGTERM"},
    )
    parser.add_argument("bag", type=Path, help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    parser.add_argument("-r", "--rate", type=positive, default=1.0, help="times as fast")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these of the bag")
    parser.add_argument(
        "-m", "--remap", nargs="+", metavar="OLD:=NEW", help="publish under other names"
    )
    parser.add_argument(
        "--clock",
        type=positive,
        nargs="?",
        const=100.0,
        default=100.0,
        metavar="HZ",
        help="messages on /clock a second (default 100), with the bag's time",
    )
    parser.add_argument("--no-clock", action="store_true", help="no /clock")
    parser.add_argument(
        "--start-offset", type=not_negative, default=0.0, metavar="S", help="start so far in"
    )
    parser.add_argument(
        "--playback-duration", type=positive, metavar="S", help="stop after S s of bag time"
    )
    parser.add_argument("-l", "--loop", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument("-p", "--start-paused", action="store_true", help="wait for ~/pause false")
    parser.add_argument(
        "-d", "--delay", type=not_negative, default=0.0, metavar="S", help="wait before the start"
    )
    parser.add_argument(
        "--wait-for-subscribers",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="wait up to S s until every topic has a subscriber; without it, play starts when no"
        " new subscriber was found for 0.5 s",
    )
    parser.add_argument(
        "--stamps",
        choices=("bag", "log"),
        default="bag",
        help="stamps in headers: as they are (default), or each message's log time",
    )
    add_json(parser)
    options = parser.parse_args(arguments)
    for rule in options.remap or []:
        old, separator, new = rule.partition(":=")
        if not separator:
            parser.error(f"--remap wants OLD:=NEW, not {rule!r}")
        try:
            check_topic_name(old)
            check_topic_name(new)
        except BagError as error:
            parser.error(str(error))
    return options


def main() -> None:
    """Run the command; see `play --help`."""
    own, ros = split_ros_arguments(sys.argv[1:])
    options = parse(own)
    try:
        with open_bag(options.bag) as bag:
            replay = Replay(options, bag, ros)
            number = replay.run()
            result = replay.result(number)
            print(json.dumps(result) if options.json else replay.summary(number))
    except GalenError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(EXIT_FAILED) from None
    raise SystemExit(EXIT_OK if number is None else EXIT_SIGNAL + number)


if __name__ == "__main__":
    main()
