# SPDX-License-Identifier: Apache-2.0
"""Where a collection is recorded: its folder, and bags beside a node that is busy.

    <recordings_dir>/<name>/push/, calibration_1/, calibration_2/    rosbag2 directories (MCAP)
    <recordings_dir>/<name>/tool.json                                the tool's file as it was
    <recordings_dir>/<name>/collection.json                          what was asked and what came

It grows as `<name>.unfinished` (a name that no collection can have) and is renamed in one step at
the end. What a canceled, failed or killed collection has recorded until then stays there and can be
read; one that has recorded nothing leaves nothing.

The recorder has a thread and executor of its own: it takes messages in batches from its
subscriptions' queues, which only an executor that respects callback groups leaves alone; and it
must not wait for the node's work.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.ros.recorder import RecorderNode
from galen_model.files.atomic_file import write_whole
from galen_model.files.calibration_file import CalibrationFile, check_tool_name, write_calibration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from galen_deflection.measurement.samples import DeflectionError

_SPIN_S = 0.05
TOOL_FILE, SUMMARY_FILE = "tool.json", "collection.json"
_MOST_UNFINISHED = 1000


class CollectionFolder:
    """One collection's folder, from its making to its name."""

    def __init__(self, recordings_dir: Path, name: str) -> None:
        """Only checks; raises ToolNameError and DeflectionError."""
        self.final = recordings_dir / check_tool_name(name, "recording's")
        self._reject_existing()
        self.path = self.final

    def make(self, tool: CalibrationFile) -> None:
        """Make the unfinished folder with the tool's file in it.

        Args:
            tool: calibration of the tool that is on.

        Raises:
            DeflectionError: the folder can't be made.
            GalenError: the tool's file can't be written.

        """
        try:
            self.final.parent.mkdir(parents=True, exist_ok=True)
            self.path = self._make_unfinished()
        except OSError as error:
            raise DeflectionError(f"{self.final}: can't be made: {error}") from error
        write_calibration(self.path / TOOL_FILE, tool)

    def close(self, summary: Mapping[str, Any], *, finished: bool) -> Path:
        """Write the summary.

        Args:
            summary: content of `collection.json`.
            finished: whether the folder gets its own name.

        Returns:
            The folder, under its own name if it is finished.

        Raises:
            DeflectionError: something can't be written; all that was recorded is then in `path`.

        """
        text = json.dumps(summary, indent=2) + "\n"
        try:
            write_whole(self.path / SUMMARY_FILE, text)
            if finished:
                self._reject_existing()  # one made meanwhile is not written over
                self.path.rename(self.final)
                self.path = self.final
        except OSError as error:
            raise DeflectionError(f"{self.path}: can't be written: {error}") from error
        return self.path

    def discard(self) -> None:
        """Remove it again: nothing was recorded."""
        if self.path != self.final:
            shutil.rmtree(self.path, ignore_errors=True)

    def _make_unfinished(self) -> Path:
        for number in range(1, _MOST_UNFINISHED):
            path = self.final.with_name(
                f"{self.final.name}.unfinished" + (f"-{number}" if number > 1 else "")
            )
            try:
                path.mkdir()
            except FileExistsError:
                continue
            return path
        raise DeflectionError(f"{self.final}.unfinished: there are too many of them")

    def _reject_existing(self) -> None:
        if os.path.lexists(self.final):
            raise DeflectionError(f"{self.final}: is there already, and is not written over")


class BagRecording:
    """Bags one after the other, from the first message to the last.

    The subscriptions are the same for all of them: a new one takes seconds to get its first message
    where a machine is short of time.
    """

    def __init__(self, node: Node, path: Path, topics: Sequence[str]) -> None:
        """Begin to record `topics` (full names) as `node` hears them; raises BagError."""
        self._bag = GrowingBagWriter(path).__enter__()
        self._stop = threading.Event()
        self._jobs: SimpleQueue[tuple[Callable[[], None], Future[None]]] = SimpleQueue()
        self._error = ""
        self._messages_before = 0
        self._topics = len(topics)
        # Remappings are in the topics' names already, and one of __node would rename this, too.
        self._node = RecorderNode(
            self._bag,
            topics,
            node_name=f"{node.get_name()}_recorder",
            namespace=node.get_namespace(),
            context=node.context,
            use_global_arguments=False,
            parameter_overrides=[
                Parameter("use_sim_time", value=bool(node.get_parameter("use_sim_time").value))
            ],
        )
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="recorder", daemon=True)
        self._thread.start()

    @property
    def ready(self) -> bool:
        """Whether every topic has brought a message."""
        counts_by_topic = self._node.counts_by_topic
        return len(counts_by_topic) == self._topics and all(
            counts.messages for counts in counts_by_topic
        )

    @property
    def error(self) -> str:
        """Why it stopped by itself; empty while it runs."""
        return self._error

    @property
    def messages(self) -> int:
        """Messages written so far, into all bags."""
        return self._messages_before + self._node.messages

    def change(self, path: Path) -> list[str]:
        """Go on in another bag.

        Args:
            path: the next bag, which must not exist.

        Returns:
            What was wrong with the bag before, a sentence each.

        Raises:
            BagError: the new bag can't be made, or the recording has stopped.

        """
        problems = self._problems()
        new = GrowingBagWriter(path).__enter__()
        done: Future[None] = Future()
        self._jobs.put((lambda: self._change(new), done))
        while not done.done():
            if not self._thread.is_alive():
                new.__exit__(None, None, None)
                raise BagError(self._error)
            self._thread.join(timeout=0.005)
        done.result()
        return problems

    def _change(self, new: GrowingBagWriter) -> None:
        """In the recorder's thread."""
        self._messages_before += self._node.change_bag(new)
        old, self._bag = self._bag, new
        old.__exit__(None, None, None)

    def close(self) -> list[str]:
        """Write what still waits, close the bag, and say what was wrong; raises BagError."""
        self._stop.set()
        self._thread.join()
        try:
            self._executor.remove_node(self._node)
            self._node.destroy_node()
            self._executor.shutdown()
        finally:
            self._bag.__exit__(None, None, None)
        return self._problems()

    def _problems(self) -> list[str]:
        return [
            f"{self._bag.path.name}: {topic}: {problem}"
            for topic, problem in self._node.problems().items()
            if topic != "/clock"  # what came before it came before the recording was waited for
        ]

    def _spin(self) -> None:
        try:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=_SPIN_S)
                self._work()
        except BagError as error:
            self._error = str(error)
        except Exception as error:  # a bug must not be a recording that just ends
            self._error = f"{self._bag.path}: {type(error).__name__}: {error}"

    def _work(self) -> None:
        try:
            job, done = self._jobs.get_nowait()
        except Empty:
            return
        try:
            job()
        except Exception as error:  # it is raised again where it is waited for
            done.set_exception(error)
        else:
            done.set_result(None)
