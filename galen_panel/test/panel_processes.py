# SPDX-License-Identifier: Apache-2.0
"""The panel, and the nodes that it shows, as processes of their own; each is ended by its id."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

from galen_bringup.processes import QUICK, executable_path, ros_arguments
from galen_panel.options import TOKEN_VARIABLE
from galen_ros.node.spin import DomainLock

BEHAVIOUR = {
    **QUICK,
    # A machine with other work is no fault.
    "silent_timeout_s": 30.0,
    "service_timeout_s": 60.0,
    "max_stamp_step_s": 0.5,
}
FAKE_PANEL = Path(__file__).with_name("fake_panel.py")
PATIENCE_S = 60.0
_POLL_S = 0.02
# NiceGUI behaves otherwise where it sees pytest's variable.
_NOT_HANDED_ON = (TOKEN_VARIABLE, "PYTEST_CURRENT_TEST")


def free_port():
    with closing(socket.socket()) as trial:
        trial.bind(("127.0.0.1", 0))
        return trial.getsockname()[1]


class PanelWorld:
    """Processes in a ROS domain of their own; logs and tools' files lie in `folder`.

    with PanelWorld(tmp_path) as world:
        link = world.start_panel()
        world.start_node("galen_gravcomp", "gravcomp_node", {"tools_dir": world.tools_dir})
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        self.tools_dir = self.folder / "tools"
        self.tools_dir.mkdir(exist_ok=True)
        self.processes = {}

    def __enter__(self):
        self._stack = ExitStack()
        lock = DomainLock()
        self._stack.callback(lock.release)
        self.domain_id = lock.domain_id
        self._stack.callback(self._end_all)
        return self

    def __exit__(self, *error):
        if error[0] is not None:  # pytest shows it with the failure
            for log in sorted(self.folder.glob("*.log")):
                print(f"---- {log.name}\n{log.read_text(errors='replace')[-3000:]}")
        return self._stack.__exit__(*error)

    def start(self, name, command, niceness=0, **environment):
        """Start a process; what it says goes to the file that `log` reads."""
        assert name not in self.processes
        clean = {key: text for key, text in os.environ.items() if key not in _NOT_HANDED_ON}
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                ["nice", "-n", str(niceness), *(str(word) for word in command)],
                env=clean | {"ROS_DOMAIN_ID": str(self.domain_id)} | environment,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def start_node(self, package, executable, parameters=None, niceness=0):
        command = [executable_path(package, executable), *ros_arguments(parameters)]
        self.start(executable, command, niceness)

    def start_driver(self, speed=2.0, **parameters):
        """Where the machine is short of time, the simulation must be what slows down."""
        given = {"speed_factor": speed, "seed": 1} | parameters
        self.start_node("galen_sim_driver", "sim_driver_node", given, niceness=2)

    def start_gravcomp(self, **parameters):
        self.start_node(
            "galen_gravcomp",
            "gravcomp_node",
            {"tools_dir": self.tools_dir, "use_sim_time": True} | parameters,
        )

    def start_calibration(self, **parameters):
        """A sweep visits 12 poses."""
        few = {"tools_dir": self.tools_dir, "itersT": 3, "itersR": 4, "average_s": 0.25}
        self.start_node(
            "galen_calibration_behavior", "calibration_node", BEHAVIOUR | few | parameters
        )

    def start_panel(self, *arguments, fake=False, port=None, **environment):
        """Start it and return its link, when it answers there."""
        port = port or free_port()
        program = [executable_path("galen_panel", "panel")]
        if fake:
            program = [sys.executable, FAKE_PANEL]
        folders = ["--tools-dir", self.tools_dir, "--output-dir", self.folder / "panel"]
        self.start("panel", [*program, "--port", port, *folders, *arguments], **environment)
        self.wait_for(lambda: _answers(port), "the panel to answer")
        lines = self.log("panel").splitlines()
        return [line for line in lines if line.startswith("panel: open ")][-1].split()[-1]

    def log(self, name):
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def kill(self, name):
        """As when the machine loses it: it can't say anything more."""
        self.end(name, signal.SIGKILL)

    def end(self, name, number=signal.SIGINT, patience_s=PATIENCE_S):
        """Send it a signal and return its exit code."""
        process = self.processes.pop(name)
        process.send_signal(number)
        try:
            return process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise AssertionError(f"{name} did not end within {patience_s} s") from None

    def wait_for(self, predicate, what, patience_s=PATIENCE_S):
        """Until the predicate holds, while all processes live; returns its value."""
        deadline = time.monotonic() + patience_s
        while not (value := predicate()):
            for name, process in self.processes.items():
                assert process.poll() is None, f"{name} ended:\n{self.log(name)}"
            assert time.monotonic() < deadline, f"waited {patience_s} s in vain for {what}"
            time.sleep(_POLL_S)
        return value

    def _end_all(self):
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        for process in self.processes.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _answers(port):
    with closing(socket.socket()) as trial:
        return trial.connect_ex(("127.0.0.1", port)) == 0
