# SPDX-License-Identifier: Apache-2.0
"""Makes `.venv`, with ROS 2 from PyPI or on top of an installed one."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

from . import machine
from .machine import Interpreter, Progress, Ros, SetupError, choose, find_ros

LAYOUT = 2  # raise it when an environment made by older code is no longer good
RCLPY_VERSION = "7.1.6"  # Jazzy's; a later one is another distribution
GROUPS = ("runtime", "build", "ros")
# What each must be able to import, and the room that it takes with its download.
OPTIONAL_GROUPS = {
    "dev": ("import hypothesis, mujoco, pytest, s3fs", 500_000_000),
    "docs": ("import mkdocs, material, mkdocstrings", 200_000_000),
    "networks": ("import torch", 9_000_000_000),
    "arms": ("import importlib.metadata as m; m.files('example-robot-data')[0]", 700_000_000),
}
STAMP_NAME = "galen_env.json"
# Always ours, also where ROS's Debian packages bring another version: what tests and checks.
ALWAYS_OURS = "dev"
# pip's settings that uv has under another name; uv knows no file of pip's.
_UV_NAMES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "retries": "UV_HTTP_RETRIES",
    "no-cache-dir": "UV_NO_CACHE",
    "cert": "SSL_CERT_FILE",
    "proxy": "ALL_PROXY",
}

_INSTALLED = """
import importlib.metadata as m, json
print(json.dumps({d.name: d.version for d in m.distributions() if d.name}))
"""
_CHECK = """
import distributed, matplotlib, numpy, pinocchio, rclpy, rich, rosbags, scipy, tqdm, yaml
import sensor_msgs.msg, std_srvs.srv, trajectory_msgs.msg
sensor_msgs.msg.JointState.__class__.__import_type_support__()
"""
_INCLUDES = """
import numpy, sysconfig
print(sysconfig.get_paths()["include"])
print(numpy.get_include())
"""


def normal_name(name: str) -> str:
    """Return a distribution's name in the one spelling that an index compares."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_pins(path: Path) -> dict[str, str]:
    """Return the entries of a lock file, ``version --hash=... --hash=...``, by name.

    Raises:
        SetupError: an entry is not ``name==version`` with at least one hash.

    """
    pins = {}
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    for line in (line.split("#")[0].strip() for line in text.splitlines()):
        if not line:
            continue
        name, equals, entry = line.partition("==")
        if not equals or " --hash=sha256:" not in entry:
            raise SetupError(f"{path}: '{line[:60]}' is not name==version with a hash")
        pins[normal_name(name)] = " ".join(entry.split())
    return pins


def to_install(
    pins: Mapping[str, Mapping[str, str]], installed: Mapping[str, str], ros: Ros | None
) -> dict[str, str]:
    """Return what has to be installed.

    Args:
        pins: versions by name, by group.
        installed: versions that the environment already has, from ROS and the system.
        ros: the installed ROS; None takes everything from the pins.

    Returns:
        Versions by name. On an installed ROS only what it does not bring: its messages are
        compiled against its numpy, and its tools expect its versions.

    """
    if ros is None:
        return {name: version for group in GROUPS for name, version in pins[group].items()}
    present = {normal_name(name) for name in installed}
    pinned = {**pins["runtime"], **pins["build"]}
    return {name: version for name, version in pinned.items() if name not in present}


def uv_settings(pip_config: str, environ: Mapping[str, str]) -> dict[str, str]:
    """Return as variables of uv what ``pip config list`` printed; those in ``environ`` win."""
    lines = [re.fullmatch(r"(.+)\.([a-z-]+)='(.*)'", line) for line in pip_config.splitlines()]
    sections = ("global", "install", ":env:")  # the later wins, as in pip
    found = sorted(
        (sections.index(line[1]), line[2], line[3])
        for line in lines
        if line and line[1] in sections and line[2] in _UV_NAMES
    )
    settings = {}
    for _, name, value in found:
        # Lists: uv has commas between links, and both have blanks elsewhere.
        words = value.replace("\\n", " ").split()
        settings[_UV_NAMES[name]] = ("," if name == "find-links" else " ").join(words)
    return {name: value for name, value in settings.items() if name not in environ}


def explain_pip(log: str) -> str:
    """Return in a few words why pip failed, from its output."""
    if re.search(r"No space left on device|\[Errno 28\]|Disk quota exceeded", log):
        return "the disk is full: free some space"
    if re.search(r"NewConnection|Connect|Timeout|name resolution|ProxyError|SSLError", log):
        return "the package index did not answer: check the connection and pip's configuration"
    missing = re.search(r"No matching distribution found for (\S+)", log)
    if missing:
        return (
            f"the package index did not answer or does not have {missing.group(1)} for this Python "
            "and machine: check the connection and pip's configuration"
        )
    errors = re.findall(r"^ERROR: (.+)$", log, re.MULTILINE)
    return errors[-1] if errors else "pip failed"


_BUILDER = r"/opt/python/cp\d+-cp\d+"
_NUMPY = re.compile(_BUILDER + r"/lib/python3\.\d+/site-packages/numpy/(?:_core|core)/include")
_PYTHON = re.compile(_BUILDER + r"/include/python3\.\d+")


def repair_wheels(prefix: Path, python_include: str, numpy_include: str) -> int:
    """Rewrite the builder's folders in ``<prefix>/share/*/cmake/*.cmake`` of the ROS wheels.

    Their exported targets name the folders of the machine that built them.

    Returns:
        How many files were changed; a second call changes none.

    """
    changed = 0
    for path in sorted(prefix.glob("share/*/cmake/*.cmake")):
        text = path.read_text(encoding="utf-8")
        fixed = _NUMPY.sub(lambda _: numpy_include, text)
        fixed = _PYTHON.sub(lambda _: python_include, fixed)
        if fixed != text:
            path.unlink()  # else it would change in uv's cache, too, to which it is a hard link
            path.write_text(fixed, encoding="utf-8")
            changed += 1
    return changed


class Environment:
    """The environment of the workspace at ``root``."""

    def __init__(self, root: Path, environ: Mapping[str, str]) -> None:
        """Look at what is sourced; nothing is made yet."""
        self.root = root
        self.environ = clean_environ(environ, root)
        self.path = root / ".venv"
        self.python = self.path / "bin" / "python"
        self.log = root / "log" / "setup.log"
        self.ros = find_ros(self.environ)

    def key(self) -> str:
        """Return a hash of all that the environment is made from, but the Python."""
        digest = hashlib.sha256(f"{LAYOUT} {self.ros}".encode())
        for group in GROUPS:
            digest.update((self.root / "requirements" / f"{group}.txt").read_bytes())
        return digest.hexdigest()

    def is_ready(self) -> bool:
        """Return whether `.venv` was made to its end, from today's requirements."""
        try:
            stamp = json.loads((self.path / STAMP_NAME).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        forced = self.environ.get("GALEN_PYTHON")
        if forced and stamp.get("forced_python") != forced:
            return False
        return stamp.get("key") == self.key() and os.access(self.python, os.X_OK)

    def make(self) -> None:
        """Make `.venv`, unless a good one is there.

        Raises:
            SetupError: a part is missing or a download fails; `.venv` then has no stamp, so that
                the next run makes it anew.

        """
        if self.is_ready():
            return
        machine.check_tools(self.environ)
        if self.ros is None:
            machine.check_platform()
        interpreter = choose(self.environ, self.ros)
        self._remove_old()
        machine.check_disk(self.root)
        origin = f"the ROS 2 in {self.ros.prefix}" if self.ros else "PyPI"
        print(f"Making .venv: Python {interpreter.version}, ROS 2 from {origin}", flush=True)
        started = time.monotonic()
        self.log.parent.mkdir(exist_ok=True)
        self.log.write_text("", encoding="utf-8")
        try:
            self._fill(interpreter)
        except OSError as error:
            raise SetupError(f"cannot make {self.path}: {error}") from error
        print(f"Environment ready after {time.monotonic() - started:.0f} s.", flush=True)

    def add(self, group: str) -> None:
        """Install one of the OPTIONAL_GROUPS beside the rest, unless it is there.

        Raises:
            SetupError: the disk is too full or a download fails; the rest stays as it was.

        """
        path = self.root / "requirements" / f"{group}.txt"
        stamp = self.path / f"galen_{group}.txt"
        if stamp.is_file() and stamp.read_bytes() == path.read_bytes():
            return
        check, needed_bytes = OPTIONAL_GROUPS[group]
        machine.check_disk(self.root, needed_bytes)
        self.log.parent.mkdir(exist_ok=True)
        stamp.unlink(missing_ok=True)
        pins = read_pins(path)
        if self.ros is not None and group != ALWAYS_OURS:  # what it brings, it was built with
            present = {normal_name(name) for name in json.loads(self._ask(_INSTALLED))}
            pins = {name: version for name, version in pins.items() if name not in present}
        self._install(pins)
        self._run(
            [str(self.python), "-c", check],
            self.variables(),
            f"{path.name} was installed, but a package in it does not import",
        )
        stamp.write_bytes(path.read_bytes())

    def variables(self) -> dict[str, str]:
        """Return the environment variables to run commands of the environment with."""
        env = dict(self.environ)
        env["VIRTUAL_ENV"] = str(self.path)
        env["PATH"] = f"{self.path / 'bin'}{os.pathsep}{env.get('PATH', os.defpath)}"
        if self.ros is None:
            env["AMENT_PREFIX_PATH"] = str(self.path)
            env["CMAKE_PREFIX_PATH"] = str(self.path)
            env.pop("PYTHONPATH", None)
        return env

    def _remove_old(self) -> None:
        if self.path.is_symlink() or (self.path.exists() and not self.path.is_dir()):
            raise SetupError(f"{self.path} is not a folder: move it away, then run it again")
        if not self.path.exists():
            return
        if not (self.path / "pyvenv.cfg").is_file() and any(self.path.iterdir()):
            raise SetupError(f"{self.path} is not a Python environment: move it away, run it again")
        (self.path / STAMP_NAME).unlink(missing_ok=True)
        shutil.rmtree(self.path)

    def _fill(self, interpreter: Interpreter) -> None:
        command = [interpreter.path, "-m", "venv", str(self.path)]
        if self.ros:
            command.insert(3, "--system-site-packages")
        # No PYTHONPATH: what is on it must not count as the interpreter's own.
        bare = {k: v for k, v in self.environ.items() if k != "PYTHONPATH"}
        self._run(command, bare, f"{interpreter.path} could not make an environment")
        (self.path / "COLCON_IGNORE").touch()
        link_setup(self.root, self.path, "local_setup")

        pins = {group: read_pins(self.root / "requirements" / f"{group}.txt") for group in GROUPS}
        installed = json.loads(self._ask(_INSTALLED)) if self.ros else {}
        wanted = to_install(pins, installed, self.ros)
        # Packages without a wheel are built with this setuptools, not with any newer one.
        self._install({n: v for n, v in wanted.items() if n == "setuptools"})
        self._install({n: v for n, v in wanted.items() if n != "setuptools"})

        if self.ros is None:
            python_include, numpy_include = self._ask(_INCLUDES).split("\n")
            repair_wheels(self.path, python_include, numpy_include)
            found = json.loads(self._ask(_INSTALLED)).get("ros-rclpy")
            if found != RCLPY_VERSION:
                raise SetupError(f"rclpy is {found}, and ROS 2 Jazzy's is {RCLPY_VERSION}")
        self._run(
            [str(self.python), "-c", _CHECK],
            self.variables(),
            "the environment was made, but a package in it does not import",
        )
        self._write_stamp(interpreter)

    def _ask(self, code: str) -> str:
        done = subprocess.run(
            [str(self.python), "-c", code],
            env=self.variables(),
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SetupError(f"{self.python} does not run: {done.stderr.strip()[-200:]}")
        return done.stdout.strip()

    def _run(self, command: list[str], env: Mapping[str, str], failure: str) -> None:
        with self.log.open("a", encoding="utf-8") as log:
            log.write(f"$ {' '.join(command)}\n")
            log.flush()
            done = subprocess.run(command, env=dict(env), stdout=log, stderr=log, check=False)
        if done.returncode:
            last = self.log.read_text(encoding="utf-8").strip().splitlines()[-1]
            raise SetupError(f"{failure} ({last.strip()}); see {self.log}")

    def _install(self, pins: Mapping[str, str]) -> None:
        """Install ``pins`` and nothing else: with uv, or else with pip, which is slower."""
        if not pins:
            return
        wanted = self.path / "galen_wanted.txt"
        wanted.write_text("".join(f"{name}=={pin}\n" for name, pin in pins.items()), "utf-8")
        options = ["install", "--no-deps", "--no-build-isolation", "-r", str(wanted)]
        env = self.variables()
        uv = self._uv()
        with Progress(f"Fetching {len(pins)} package{'s' if len(pins) > 1 else ''}") as progress:
            if uv:
                config = subprocess.run(
                    [str(self.python), "-m", "pip", "config", "list"],
                    env=env,
                    capture_output=True,
                    text=True,
                    check=False,
                )
                command = [uv, "pip", *options, "--python", str(self.python)]
                settings = uv_settings(config.stdout, env)
                if not progress.run(command, {**env, **settings}, self.log)[0]:
                    return
            # Python compiles what is imported when it is; to compile all takes a quarter of the
            # time.
            quiet = ["--disable-pip-version-check", "--no-input", "--progress-bar", "off"]
            command = [str(self.python), "-m", "pip", *options, *quiet, "--no-compile"]
            code, text = progress.run(command, env, self.log)
        if code:
            raise SetupError(f"{explain_pip(text)}; see {self.log}")

    def _uv(self) -> str | None:
        """Return the path of uv: the one on PATH, or the environment's, installed if it can be."""
        own = self.path / "bin" / "uv"
        if found := shutil.which("uv", path=self.variables()["PATH"]):
            return found
        command = [str(self.python), "-m", "pip", "install", "--quiet", "--no-deps"]
        command += ["--disable-pip-version-check", "--no-input", "--only-binary", ":all:"]
        command += ["-r", str(self.root / "requirements" / "uv.txt")]
        with self.log.open("a", encoding="utf-8") as log:
            done = subprocess.run(
                command, env=self.variables(), stdout=log, stderr=log, check=False
            )
        return None if done.returncode or not own.is_file() else str(own)

    def _write_stamp(self, interpreter: Interpreter) -> None:
        lines = [f"GALEN_ENV_KIND={'ros' if self.ros else 'pypi'}"]
        lines.append(f"GALEN_ROS_PREFIX='{self.ros.prefix if self.ros else ''}'")
        (self.path / "galen_env.sh").write_text("\n".join(lines) + "\n", encoding="utf-8")
        stamp = {
            "key": self.key(),
            "python": interpreter.path,
            "forced_python": self.environ.get("GALEN_PYTHON"),
        }
        unfinished = self.path / (STAMP_NAME + ".new")
        unfinished.write_text(json.dumps(stamp, indent=2) + "\n", encoding="utf-8")
        unfinished.replace(self.path / STAMP_NAME)


def link_setup(root: Path, prefix: Path, *names: str) -> None:
    """Make scripts/env.sh the set-up scripts ``names`` of ``prefix``, a folder in ``root``."""
    for name in names:
        for shell in ("bash", "zsh"):
            (prefix / f"{name}.{shell}").symlink_to(root / "scripts" / "env.sh")


def clean_environ(environ: Mapping[str, str], root: Path) -> dict[str, str]:
    """Return ``environ`` without what an earlier `source` of this workspace put on its paths."""
    env = dict(environ)
    ours = (str(root / "install"), str(root / ".venv"), str(root / "build"))
    for name in (
        "AMENT_PREFIX_PATH",
        "CMAKE_PREFIX_PATH",
        "COLCON_PREFIX_PATH",
        "LD_LIBRARY_PATH",
        "PATH",
        "PYTHONPATH",
    ):
        if name in env:
            kept = [p for p in env[name].split(os.pathsep) if not _is_below(p, ours)]
            env[name] = os.pathsep.join(kept)
            if not env[name]:
                del env[name]
    # The last is how the ROS wheels mark that LD_LIBRARY_PATH already names their libraries.
    for name in ("VIRTUAL_ENV", "PYTHONHOME", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        env.pop(name, None)
    return env


def _is_below(path: str, folders: tuple[str, ...]) -> bool:
    return any(path == folder or path.startswith(folder + os.sep) for folder in folders)
