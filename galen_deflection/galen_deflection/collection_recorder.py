"""Records topics into a bag beside a node that is busy, in a thread and executor of its own.

The recorder takes messages in batches from its subscriptions' queues, which only an executor that
respects callback groups leaves alone; and it must not wait for what the node has to do.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from galen_bags.errors import BagError
from galen_bags.growing_bag import GrowingBagWriter
from galen_bags.recorder import RecorderNode
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

_SPIN_S = 0.05


class BagRecording:
    """One bag, from the first message to the last."""

    def __init__(self, node: Node, path: Path, topics: Sequence[str]) -> None:
        """Begin to record `topics` (full names) as `node` hears them; raises BagError."""
        self._bag = GrowingBagWriter(path).__enter__()
        self._stop = threading.Event()
        self._error = ""
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
        tallies = self._node.tallies
        return len(tallies) == self._topics and all(tally.messages for tally in tallies)

    @property
    def error(self) -> str:
        """Why it stopped by itself; empty while it is well."""
        return self._error

    @property
    def messages(self) -> int:
        """Messages written so far."""
        return self._node.messages

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
        return [
            f"{self._bag.path.name}: {topic}: {problem}"
            for topic, problem in self._node.problems().items()
            if topic != "/clock"  # what came before it came before the recording was waited for
        ]

    def _spin(self) -> None:
        try:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=_SPIN_S)
        except BagError as error:
            self._error = str(error)
        except Exception as error:  # a bug must not be a recording that just ends
            self._error = f"{self._bag.path}: {type(error).__name__}: {error}"
