# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, fed by a driver in the test that can do everything wrong."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from fault_arm import (
    ADAPTER_COM_M,
    ADAPTER_KG,
    COM_M,
    JOINTS,
    MASS_KG,
    PERIOD_NS,
    S,
    Source,
    weight,
)
from galen_deflection.models.file import write_model
from galen_deflection.models.interface import FittedRange
from galen_deflection.models.spring_model import SpringBasis, SpringModel
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    write_calibration,
    zeroed_at,
)
from galen_model.load.model import LoadEstimate
from galen_ros.messages import STREAM, stamp_to_ns, wrench_to_array
from galen_ros.node.testing import Harness
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

from galen_msgs.msg import DeflectionStamped
from galen_msgs.srv import SetTool

TIP_M = np.array([0.18, 0.01, 0.05])
PATIENCE_S = 100.0


def write_tool_file(folder, mass_kg=MASS_KG):
    """Write the retractor's file; returns its path."""
    tight = np.eye(4) * 1e-10
    tool = CalibrationFile(
        tool="retractor",
        load=LoadEstimate(mass_kg, COM_M, tight),
        adapter=LoadEstimate(ADAPTER_KG, ADAPTER_COM_M, tight),
        tip_m=TIP_M,
        rmse=np.zeros(6),
        poses_used=56,
        calibrated_at="2026-01-01T00:00:00+00:00",
        arm=GALEN,
        zeroing=zeroed_at(arm=GALEN),
    )
    path = calibration_path(folder, "retractor")
    write_calibration(path, tool)
    return path


def write_model_file(path):
    """The nominal arm's stiffness, as if fitted on anything an arm can do."""
    basis = SpringBasis(TIP_M, arm=GALEN)
    values = np.array([parameter.prior for parameter in basis.compliances])
    noise = np.array([3e-5] * 3 + [1e-4] * 3)
    model = SpringModel(
        "joint_stiffness",
        basis,
        values,
        np.diag((0.01 * values) ** 2),
        np.diag(noise**2) * 0.01,
        noise,
        FittedRange(
            np.full(6, -500.0), np.full(6, 500.0), np.full(5, -4.0), np.full(5, 4.0), arm=GALEN
        ),
        {"samples": len(values), "segments": 1, "positions": 1, "sets": 1},
    )
    write_model(path, model)


class Listener(Node):
    """What a user sees: the outputs and /diagnostics."""

    def __init__(self, **options):
        super().__init__("listener", **options)
        self.wrenches, self.deflections, self.said = [], [], {}
        self.create_subscription(WrenchStamped, "wrench_compensated", self.on_wrench, STREAM)
        self.create_subscription(DeflectionStamped, "deflection", self.on_deflection, STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 100)
        self.set_tool = self.create_client(SetTool, "gravcomp/set_tool")

    def on_wrench(self, message):
        self.wrenches.append((stamp_to_ns(message.header.stamp), wrench_to_array(message)))

    def on_deflection(self, message):
        self.deflections.append(stamp_to_ns(message.header.stamp))

    def on_diagnostics(self, message):
        for status in message.status:
            self.said.setdefault(status.name, []).append(status)


class FaultWorld:
    """Processes in a domain of their own; `raw` and `angles` are what was published, by stamp."""

    def __init__(self, folder):
        self.folder = folder
        self.processes = {}
        self.raw, self.angles = {}, {}
        self.stamp = 100_000 * S
        self.step_number = 0
        self.rng = np.random.default_rng(7)

    def __enter__(self):
        self.stack = ExitStack()
        self.harness = self.stack.enter_context(Harness())
        self.stack.callback(self.stop_all)
        self.listener = self.harness.add(lambda context: Listener(context=context))
        return self

    def __exit__(self, *error):
        self.stack.__exit__(*error)

    # processes

    def start(self, name, arguments, parameters=None, remaps=None):
        """Start `python arguments` as a process."""
        values = [word for p in (parameters or {}).items() for word in ("-p", f"{p[0]}:={p[1]}")]
        names = [word for r in (remaps or {}).items() for word in ("-r", f"{r[0]}:={r[1]}")]
        ros = ["--ros-args"] if values or names else []
        log = self.stack.enter_context((self.folder / f"{name}.log").open("wb"))
        self.processes[name] = subprocess.Popen(
            [sys.executable, *arguments, *ros, *values, *names],
            env={**os.environ, "ROS_DOMAIN_ID": str(self.harness.domain_id)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        return self.processes[name]

    def kill(self, name):
        process = self.processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def stop_all(self):
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
        for process in self.processes.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def wait_for(self, predicate, what, feed=None, patience_s=PATIENCE_S):
        """Until the predicate holds; `feed` meanwhile, at the stamps' rate."""

        def look():
            for name, process in self.processes.items():
                assert process.poll() is None, (self.folder / f"{name}.log").read_text()
            if feed is not None:
                feed()
                time.sleep(PERIOD_NS * 1e-9)
            return predicate()

        return self.harness.wait_for(look, patience_s, what)

    # samples

    def source(self, name):
        source = self.harness.add(lambda context: Source(name, context=context))
        for publisher in (source.joints_out, source.wrench_out):
            self.wait_for(publisher.get_subscription_count, "a subscription to the driver")
        return source

    @contextmanager
    def beside(self, source, name, remaps=()):
        """Another driver, found while the first one sends without a pause, and gone in the end."""
        arguments = [word for pair in remaps for word in ("-r", pair)]
        with ThreadPoolExecutor(1) as thread:
            made = thread.submit(
                self.harness.add,
                lambda context: Source(
                    name, context=context, cli_args=["--ros-args", *arguments] if remaps else None
                ),
            )
            self.wait_for(made.done, f"the driver {name}", lambda: self.step(source))
        try:
            yield made.result()
        finally:
            self.harness.remove(made.result())

    def arm(self):
        """Where the arm is now, and what the sensor reads there with a push of the hand on it."""
        self.step_number += 1
        roll = 0.5 * np.sin(0.05 * self.step_number)
        tilt = 0.4 * np.cos(0.03 * self.step_number)
        push = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])
        noise = self.rng.normal(size=6) * [0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4]
        return roll, tilt, weight(roll, tilt) + push + noise

    def step(self, source, frame_id="ft_sensor", names=JOINTS, wrench=None):
        """One good sample, but for what is asked otherwise; returns its stamp."""
        self.stamp += PERIOD_NS
        roll, tilt, live = self.arm()
        self.joints(source, self.stamp, roll, tilt, names)
        self.wrench(source, self.stamp, live if wrench is None else wrench, frame_id)
        return self.stamp

    def joints(self, source, stamp, roll, tilt, names=JOINTS):
        self.angles[stamp] = (roll, tilt)
        source.joints(stamp, roll, tilt, names)

    def wrench(self, source, stamp, wrench, frame_id="ft_sensor"):
        self.raw.setdefault(stamp, np.asarray(wrench, dtype=float))
        source.wrench(stamp, wrench, frame_id)

    def ask_for_tool(self, source, name):
        """Call `set_tool` while samples go on; returns the answer."""
        client = self.listener.set_tool
        self.wait_for(client.service_is_ready, "set_tool", lambda: self.step(source))
        future = client.call_async(SetTool.Request(tool=name))
        self.wait_for(future.done, "set_tool's answer", lambda: self.step(source))
        return future.result()

    # what a user sees

    def newest(self, node="gravcomp"):
        said = self.listener.said.get(node)
        return said[-1] if said else None

    def says(self, words, node="gravcomp", level=None):
        """The newest report, if it says so."""
        status = self.newest(node)
        if status is None or words not in status.message:
            return None
        return status if level is None or status.level == bytes([level]) else None

    def works(self, source, node="gravcomp"):
        """Feed good samples until the node says that it works again; returns their stamps."""
        word = {"gravcomp": "compensating", "deflection": "predicting"}[node]
        fed = []
        self.wait_for(
            lambda: len(fed) > 20 and (s := self.newest(node)) and s.message.startswith(word),
            f"{node} to be well",
            lambda: fed.append(self.step(source)),
        )
        self.wait_for(lambda: fed[-1] in self.out, "the last wrench to come out")
        return fed

    @property
    def out(self):
        """Stamps of the newest compensated wrenches."""
        return {stamp for stamp, _ in self.listener.wrenches[-200:]}

    def check_outputs(self, first=0, mass_kg=MASS_KG):
        """Every output since the `first` is raw minus weight at the joints of its stamp."""
        outputs = self.listener.wrenches[first:]
        for stamp, found in outputs:
            expected = self.raw[stamp] - weight(*self.angles[stamp], mass_kg)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        return [stamp for stamp, _ in outputs]
