"""Builds the workspace with colcon, only when something that the build copies has changed."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import time
from pathlib import Path

from .environment import Environment
from .machine import SetupError

# With --symlink-install an edit in these folders or of a .py file needs no build.
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
    digest = hashlib.sha256()
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


def build(environment: Environment, *, verbose: bool = False) -> None:
    """Build all packages, unless nothing has changed since the last good build.

    Raises:
        SetupError: colcon fails; the message names the package and its log.

    """
    root = environment.root
    stamp = root / "install" / "galen_build_stamp"
    environment_key = (environment.path / "galen_env.json").read_text(encoding="utf-8")
    environment_key = hashlib.sha256(environment_key.encode()).hexdigest()
    key = f"{environment_key}\n{source_key(root)}\n"
    old = stamp.read_text(encoding="utf-8") if stamp.is_file() else ""
    if old == key:
        return
    stamp.unlink(missing_ok=True)
    packages = find_packages(root)
    if old.split("\n")[0] != environment_key:
        # Built for another Python or ROS: CMake's cache would keep that one.
        for name in ("build", "install"):
            shutil.rmtree(root / name, ignore_errors=True)
    _remove_gone(root, set(packages))
    print(f"Building {len(packages)} packages ...", flush=True)
    started = time.monotonic()
    command = [str(environment.python), "-m", "colcon", "build", "--symlink-install"]
    command += ["--cmake-args", f"-DPython3_EXECUTABLE={environment.python}"]
    command += ["-DBUILD_TESTING=OFF", "--no-warn-unused-cli"]
    log = root / "log" / "build.log"
    log.parent.mkdir(exist_ok=True)
    with log.open("w", encoding="utf-8") as file:
        output = None if verbose else file
        env = environment.variables()
        flags = env.get("MAKEFLAGS", "")
        if "-j" not in flags and "--jobs" not in flags:
            # colcon would add -l, and the compiler wait while anything else is at work.
            env["MAKEFLAGS"] = f"{flags} -j{os.cpu_count() or 1}".strip()
        done = subprocess.run(command, cwd=root, env=env, stdout=output, stderr=output, check=False)
    if done.returncode:
        raise SetupError(_explain(root, log))
    stamp.write_text(key, encoding="utf-8")
    print(f"Built after {time.monotonic() - started:.0f} s.", flush=True)


def _is_live_folder(name: str) -> bool:
    return name in _LIVE_FOLDERS or name.startswith(".") or name.endswith(".egg-info")


def _remove_gone(root: Path, packages: set[str]) -> None:
    """Remove what was built of packages that are no longer there."""
    for parent in (root / "build", root / "install"):
        for folder in parent.iterdir() if parent.is_dir() else ():
            if folder.is_dir() and folder.name not in packages:
                shutil.rmtree(folder)


def _explain(root: Path, log: Path) -> str:
    """Return one line on a failed build, and print the end of the failing package's log."""
    text = log.read_text(encoding="utf-8", errors="replace")
    if "No space left on device" in text:
        return f"the disk is full: free some space; see {log}"
    failed = [line.split()[2] for line in text.splitlines() if line.startswith("Failed   <<<")]
    if not failed:
        last = [line for line in text.splitlines() if line.strip()]
        return f"colcon failed ({last[-1].strip() if last else 'no output'}); see {log}"
    detail = root / "log" / "latest_build" / failed[0] / "stdout_stderr.log"
    if detail.is_file():
        lines = detail.read_text(encoding="utf-8", errors="replace").splitlines()
        print("\n".join(lines[-20:]), flush=True)
        log = detail
    return f"building {failed[0]} failed; see {os.path.relpath(log, root)}"
