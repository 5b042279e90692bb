"""`record`: writes what topics carry to a bag, until Ctrl-C or a limit."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_OK,
    ProgressLine,
    add_json,
    make_parser,
    positive,
)
from galen_ros.node.spin import own_arguments, run_until
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from galen_bags.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.record.recorder import DEFAULT_TOPICS, RecorderNode
from galen_bags.record.topic_counts import topic_table
from galen_bags.topics import check_topic_name

_MB = 1_000_000
_NOTES = (
    "Names of topics are relative to the namespace and can be remapped: --ros-args -r __ns:=/left"
)


class Recording:
    """One run of the command: the node, the limits, the line on the terminal."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.node: RecorderNode | None = None
        self._line = ProgressLine()
        self._first_s: float | None = None
        self._ended_by = "signal"
        self._messages_before = 0
        self._looked_s = time.monotonic()
        self._rate_hz = 0.0
        self.bag = GrowingBagWriter(options.output, compressed=not options.no_compression)

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
            lines.append(topic_table(self.node.counts_by_topic))
        lines += [f"  {name}: {problem}" for name, problem in result["problems"].items()]
        return "\n".join(lines)

    def _make_node(self) -> RecorderNode:
        options = self._options
        overrides = [Parameter("use_sim_time", value=True)] if options.use_sim_time else None
        self.node = RecorderNode(
            self.bag, options.topics, options.all, parameter_overrides=overrides
        )
        return self.node

    def _done(self, node: RecorderNode) -> bool:
        options = self._options
        now_s = time.monotonic()
        if self._first_s is None and node.messages:
            self._first_s = now_s
        elapsed_s = 0.0 if self._first_s is None else now_s - self._first_s
        if now_s - self._looked_s >= 1.0:
            self._rate_hz = (node.messages - self._messages_before) / (now_s - self._looked_s)
            self._messages_before, self._looked_s = node.messages, now_s
        self._line.show(
            lambda: (
                f"recording {elapsed_s:.0f} s: {len(node.counts_by_topic)} topics,"
                f" {node.messages} messages, {self.bag.size_bytes / _MB:.2f} MB,"
                f" {self._rate_hz:.0f} messages/s"
            )
        )
        if options.duration_s is not None and elapsed_s >= options.duration_s:
            self._ended_by = "duration"
            return True
        if options.max_size_mb is not None and self.bag.size_bytes >= options.max_size_mb * _MB:
            self._ended_by = "size"
            return True
        return False


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = make_parser(
        "record",
        "Record topics to a rosbag2 directory (MCAP), until Ctrl-C or a limit.",
        notes=_NOTES,
        ok="recorded, until a limit or a signal (Ctrl-C, SIGTERM); the bag is whole",
        failed="can't write; what is in the bag until then can be read",
        interrupted="interrupted (Ctrl-C) before the recording began",
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="TOPIC",
        help=f"topics to record (default: {' '.join(DEFAULT_TOPICS)})",
    )
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="the same, as newer ros2 bag has it",
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
    parser.add_argument("--no-compression", action="store_true", help="don't compress (zstd)")
    parser.add_argument(
        "--duration-s", type=positive, metavar="S", help="stop S seconds after the first message"
    )
    parser.add_argument(
        "--max-size-mb", type=positive, metavar="MB", help="stop when the file is so large, 10^6 B"
    )
    parser.add_argument(
        "--use-sim-time",
        action="store_true",
        help="log times from /clock; nothing is written before it comes",
    )
    add_json(parser)
    options = parser.parse_args(arguments)
    options.topics = list(dict.fromkeys(options.names + options.topics))
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


def main() -> None:
    """Run the command; see `record --help`."""
    options = parse(own_arguments(sys.argv)[1:])
    exit_code = EXIT_OK
    recording = None
    try:
        recording = Recording(options)
        if not options.json:
            print(f"recording to {options.output}; Ctrl-C ends it", file=sys.stderr, flush=True)
        recording.run()
    except GalenError as error:
        print(f"error: {error}", file=sys.stderr)
        exit_code = EXIT_FAILED
    if recording is not None and recording.node is not None:
        print(json.dumps(recording.result()) if options.json else recording.summary())
    raise SystemExit(exit_code)


if __name__ == "__main__":
    main()
