# SPDX-License-Identifier: Apache-2.0
"""Order and content of the bag that `evaluate --write-bags` writes, message by message."""

from pathlib import Path

import numpy as np
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_gravcomp.evaluate.bag import BagJob
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import write_calibration
from gravcomp_bags import START_NS, tool_file

PERIOD_NS = 2_000_000


def written(tmp_path: Path, monkeypatch, *, spoilt: bool = False):
    """Write a bag through a job; what it wrote: topic, log time and bytes, in its order.

    Spoilt, the joints come late, and the bag holds an older result.
    """
    wrench, joints = wrench_bytes("ft_sensor"), joint_state_bytes(GALEN.joint_names)
    with BagWriter(tmp_path / "bag") as bag:
        topics = {
            name: bag.add_topic(name, f"{kind}/msg/{type_name}")
            for name, kind, type_name in (
                ("joint_states", "sensor_msgs", "JointState"),
                ("wrench_raw", "geometry_msgs", "WrenchStamped"),
                ("wrench_compensated", "geometry_msgs", "WrenchStamped"),
            )
            if spoilt or name != "wrench_compensated"
        }
        messages = []
        for k in range(12_000):
            stamp = START_NS + PERIOD_NS * k
            # A joint sample that comes after later wrenches lets those wait, at a block's end too.
            joint_ns = stamp + (7 * PERIOD_NS // 2 if spoilt else 0)
            messages.append((joint_ns, "joint_states", joints.fill(stamp, [0.0] * 5, [0.0] * 5)))
            messages.append((stamp + 1, "wrench_raw", wrench.fill(stamp, [1.0] * 6)))
            if spoilt:
                messages.append((stamp + 2, "wrench_compensated", wrench.fill(stamp, [9.0] * 6)))
        for time_ns, name, data in sorted(messages, key=lambda message: message[0]):
            bag.write(topics[name], time_ns, data)
    out: list[tuple[str, int, bytes]] = []
    write = BagWriter.write

    def record(self, topic, log_time_ns, data):
        out.append((topic.topic, log_time_ns, bytes(data)))
        write(self, topic, log_time_ns, data)

    monkeypatch.setattr(BagWriter, "write", record)
    write_calibration(tmp_path / "retractor.json", tool_file())
    path = tmp_path / "bag"
    job = BagJob(tool=tmp_path / "retractor.json", bags_out=tmp_path / "out")
    return job.evaluate(path), out


def test_each_result_lies_where_its_raw_wrench_was_received(tmp_path, monkeypatch):
    result, out = written(tmp_path, monkeypatch)
    assert result.compensated == 12_000
    times = np.array([time_ns for _, time_ns, _ in out])
    assert np.all(np.diff(times) >= 0)
    of = {
        name: [time_ns for topic, time_ns, _ in out if topic == name]
        for name in ("/wrench_raw", "/wrench_compensated")
    }
    assert of["/wrench_compensated"] == of["/wrench_raw"]


def test_what_waited_from_block_to_block_is_written_and_an_older_result_replaced(
    tmp_path, monkeypatch
):
    result, out = written(tmp_path, monkeypatch, spoilt=True)
    assert result.compensated == 12_000
    assert sum(topic == "/wrench_compensated" for topic, _, _ in out) == 12_000
    old = wrench_bytes("ft_sensor").fill(START_NS, [9.0] * 6)
    assert all(data[-48:] != old[-48:] for _, _, data in out)
    with open_bag(tmp_path / "out" / "bag_compensated") as bag:
        assert bag.topics["/wrench_compensated"].count == 12_000
