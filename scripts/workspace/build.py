# SPDX-License-Identifier: Apache-2.0
"""Builds the workspace, only when something that the build copies has changed."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

from .environment import Environment, link_setup
from .machine import Progress, SetupError

# The packages are linked: an edit in these folders or of a .py file needs no build.
_LIVE_SUFFIXES = (".py", ".pyc", ".md")
_LIVE_FOLDERS = ("test", "__pycache__")
# Read by the build itself, so their text counts; of any other file only that it is there.
_BUILD_FILES = ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt")
_BUILD_SUFFIXES = (".msg", ".srv", ".action")


def find_packages(root: Path) -> dict[str, Path]:
    """Return the folders of the workspace's packages by name."""
    return {path.parent.name: path.parent for path in sorted(root.glob("*/package.xml"))}


def source_key(root: Path) -> str:
    """Return a hash of all in the packages that a build depends on."""
    digest = hashlib.sha256(Path(__file__).with_name("link.py").read_bytes())
    for folder in find_packages(root).values():
        for path in sorted(folder.rglob("*")):
            relative = path.relative_to(root)
            if not path.is_file() or any(_is_live_folder(part) for part in relative.parts[:-1]):
                continue
            if path.name in _BUILD_FILES or path.suffix in _BUILD_SUFFIXES:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                digest.update(f"{relative} {content}\n".encode())
            elif path.suffix not in _LIVE_SUFFIXES or path.name.endswith(".launch.py"):
                digest.update(f"{relative}\n".encode())
    return digest.hexdigest()


def build(environment: Environment) -> None:
    """Compile the messages and link the packages, unless nothing has changed since.

    Raises:
        SetupError: a step fails; the message names it and the log.

    """
    root = environment.root
    build_folder, install = root / "build", root / "install"
    stamp = install / "galen_build_stamp"
    environment_key = (environment.path / "galen_env.json").read_text(encoding="utf-8")
    environment_key = hashlib.sha256(environment_key.encode()).hexdigest()
    key = f"{environment_key}\n{source_key(root)}\n"
    old = stamp.read_text(encoding="utf-8") if stamp.is_file() else ""
    if old == key:
        return
    if old.split("\n")[0] != environment_key:
        # Built for another Python or ROS: CMake's cache would keep that one.
        shutil.rmtree(build_folder, ignore_errors=True)
    shutil.rmtree(install, ignore_errors=True)
    (install / "python").mkdir(parents=True)
    build_folder.mkdir(exist_ok=True)
    for folder in (build_folder, install):  # for who builds the clone with colcon, too
        (folder / "COLCON_IGNORE").touch()
    log = root / "log" / "build.log"
    log.parent.mkdir(exist_ok=True)
    log.write_text("", encoding="utf-8")
    messages = build_folder / "galen_msgs"
    configure = ["cmake", "-S", str(root / "galen_msgs"), "-B", str(messages)]
    configure += [f"-DCMAKE_INSTALL_PREFIX={install}", "-DPYTHON_INSTALL_DIR=python"]
    configure += [f"-DPython3_EXECUTABLE={environment.python}", "-DBUILD_TESTING=OFF"]
    jobs = str(os.cpu_count() or 1)
    link = Path(__file__).with_name("link.py")
    steps = {
        "configuring galen_msgs": configure,
        "compiling galen_msgs": ["cmake", "--build", str(messages), "-j", jobs, "-t", "install"],
        "linking the packages": [str(environment.python), str(link), str(root)],
    }
    with Progress("Compiling the messages, linking the packages") as progress:
        for name, command in steps.items():
            code, text = progress.run(command, environment.variables(), log)
            if code:
                if "No space left on device" in text:
                    raise SetupError(f"the disk is full: free some space; see {log}")
                print("\n" + "\n".join(text.splitlines()[-20:]), flush=True)
                raise SetupError(f"{name} failed; see {os.path.relpath(log, root)}")
    link_setup(root, install, "setup", "local_setup")
    stamp.write_text(key, encoding="utf-8")


def _is_live_folder(name: str) -> bool:
    return name in _LIVE_FOLDERS or name.startswith(".") or name.endswith(".egg-info")
