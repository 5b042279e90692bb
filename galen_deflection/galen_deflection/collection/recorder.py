"""Records topics into a bag beside a node that is busy, in a thread and executor of its own.

The recorder takes messages in batches from its subscriptions' queues, which only an executor that
respects callback groups leaves alone; and it must not wait for what the node has to do.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from queue import Empty, SimpleQueue

from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.recorder import RecorderNode
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from galen_bags import BagError

_SPIN_S = 0.05


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
        """Why it stopped by itself; empty while it is well."""
        return self._error

    @property
    def messages(self) -> int:
        """Messages written so far, into all bags."""
        return self._messages_before + self._node.messages

    def change(self, path: Path) -> list[str]:
        """Go on in another bag, and say what was wrong with the one before; raises BagError."""
        problems = self._problems()
        new = GrowingBagWriter(path).__enter__()
        done: Future[None] = Future()
        self._jobs.put((lambda: self._change(new), done))
        while not done.done():
            if not self._thread.is_alive():
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
