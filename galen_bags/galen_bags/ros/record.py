# SPDX-License-Identifier: Apache-2.0
"""`record`: writes what topics carry to a bag, until Ctrl-C or for a time."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from galen_common.command import (
    EXIT_OK,
    ProgressLine,
    add_json,
    make_parser,
    own_arguments,
    positive,
    print_json,
    run_command,
)
from galen_ros.node.spin import run_until
from rclpy.executors import SingleThreadedExecutor

from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.ros.recorder import DEFAULT_TOPICS, RecorderNode, TopicCounts
from galen_bags.ros.topics import check_topic_name

_MB = 1_000_000
_PATIENCE_S = 10.0
_NOTES = (
    "Names of topics are relative to the namespace and can be remapped: --ros-args -r __ns:=/left\n"
    "Log times from /clock: --ros-args -p use_sim_time:=true"
)


class RecordRun:
    """One run of the command: the node, the limit, the line on the terminal."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.node: RecorderNode | None = None
        self._line = ProgressLine()
        self._start_s = time.monotonic()
        self._first_s: float | None = None
        self._ended_by = "signal"
        self.bag = GrowingBagWriter(options.output)

    def run(self) -> None:
        """Record until a signal or a limit; raises BagError when the bag can't be written."""
        try:
            with self.bag:
                run_until(self._make_node, self._done, make=SingleThreadedExecutor)
        finally:
            self._line.close()

    def result(self) -> dict[str, Any]:
        """Return what was recorded, for --json."""
        node = self.node
        counts_by_topic = node.counts_by_topic if node else []
        first_ns = [counts.first_ns for counts in counts_by_topic if counts.first_ns is not None]
        last_ns = [counts.last_ns for counts in counts_by_topic if counts.last_ns is not None]
        return {
            "bag": str(self.bag.path),
            "ended_by": self._ended_by,
            "duration_s": (max(last_ns) - min(first_ns)) * 1e-9 if first_ns else 0.0,
            "size_bytes": self.bag.size_bytes,
            "messages": node.messages if node else 0,
            "topics": [counts.to_dict() for counts in counts_by_topic],
            "problems": node.problems() if node else {},
        }

    def summary(self) -> str:
        """Return what was recorded, for a person."""
        result = self.result()
        lines = [
            f"{result['bag']}: {result['messages']} messages, {result['size_bytes'] / _MB:.2f} MB,"
            f" {result['duration_s']:.1f} s"
        ]
        if self.node is not None and self.node.counts_by_topic:
            lines.append(_topic_table(self.node.counts_by_topic))
        lines += [f"  {name}: {problem}" for name, problem in result["problems"].items()]
        return "\n".join(lines)

    def _make_node(self) -> RecorderNode:
        self.node = RecorderNode(self.bag, self._options.topics, self._options.all)
        return self.node

    def _done(self, node: RecorderNode) -> bool:
        now_s, duration_s = time.monotonic(), self._options.duration_s
        if self._first_s is None and node.messages:
            self._first_s = now_s
        elapsed_s = 0.0 if self._first_s is None else now_s - self._first_s
        self._line.show(
            lambda: (
                f"recording {elapsed_s:.0f} s: {len(node.counts_by_topic)} topics,"
                f" {node.messages} messages, {self.bag.size_bytes / _MB:.2f} MB"
            )
        )
        if duration_s is None:
            return False
        over = elapsed_s >= duration_s
        if self._first_s is None:
            over = now_s - self._start_s >= max(duration_s, _PATIENCE_S)
        self._ended_by = "duration" if over else self._ended_by
        return over


def _topic_table(counts_by_topic: list[TopicCounts]) -> str:
    width = max((len(counts.name) for counts in counts_by_topic), default=0)
    lines = []
    for counts in counts_by_topic:
        rate = "" if counts.rate_hz is None else f"{counts.rate_hz:9.1f} Hz"
        lost = f"  {counts.lost} lost" if counts.lost else ""
        lines.append(
            f"  {counts.name:<{width}} {counts.messages:>9} messages {rate:12}"
            f"  {counts.type_name}{lost}"
        )
    return "\n".join(lines)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line.

    Args:
        arguments: without the program's name and without those of ROS.

    Returns:
        The options, with the defaults of topics and output filled in.

    Raises:
        SystemExit: code 2, with a message: the command line is wrong.

    """
    parser = make_parser(
        "record",
        "Record topics to a rosbag2 directory (MCAP), until Ctrl-C or for a time.",
        notes=_NOTES,
        ok="recorded, until a limit or a signal (Ctrl-C, SIGTERM); the bag is whole",
        failed="can't write; what is in the bag until then can be read",
        interrupted="interrupted (Ctrl-C) before the recording began",
    )
    parser.add_argument(
        "topics",
        nargs="*",
        metavar="TOPIC",
        help=f"topics to record (default: {' '.join(DEFAULT_TOPICS)})",
    )
    parser.add_argument(
        "-a", "--all", action="store_true", help="all topics but hidden ones, later ones too"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="BAG",
        help="directory to make (default: rosbag2_ and the time, here)",
    )
    parser.add_argument(
        "--duration-s",
        type=positive,
        metavar="S",
        help="stop S seconds after the first message; without one after S, or"
        f" {_PATIENCE_S:g} if that is more",
    )
    add_json(parser)
    options = parser.parse_args(arguments)
    options.topics = list(dict.fromkeys(options.topics))
    if options.all and options.topics:
        parser.error("--all records all topics: name none beside it")
    try:
        for name in options.topics:
            check_topic_name(name)
    except BagError as error:
        parser.error(str(error))
    options.topics = options.topics or list(DEFAULT_TOPICS)
    if options.output is None:
        options.output = Path(datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
    return options


def main() -> int:
    """Run the command; return the exit code. See `record --help`."""
    options = parse(own_arguments(sys.argv[1:]))

    def work() -> int:
        recording = RecordRun(options)
        if not options.json:
            print(f"recording to {options.output}; Ctrl-C ends it", file=sys.stderr, flush=True)
        try:
            recording.run()
        finally:
            if recording.node is not None and options.json:
                print_json(recording.result())
            elif recording.node is not None:
                print(recording.summary())
        return EXIT_OK

    return run_command("record", work)


if __name__ == "__main__":
    sys.exit(main())
