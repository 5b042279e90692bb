# SPDX-License-Identifier: Apache-2.0
"""Set-up and build: what is chosen, what stops it in one line, what a second run keeps."""

import contextlib
import fcntl
import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "scripts"))

from ros2_run import NotFoundError, find_executable  # noqa: E402
from workspace import build, environment, machine  # noqa: E402
from workspace.environment import (  # noqa: E402
    Environment,
    explain_pip,
    read_pins,
    repair_wheels,
    to_install,
)
from workspace.machine import SetupError  # noqa: E402

REQUIREMENTS = ROOT / "requirements"


def script(path, text):
    """Write an executable shell script."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n" + text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def fake_python(path, version, *, has_venv=True, has_headers=True, implementation="cpython"):
    """A program that answers the probe as a Python of that kind would."""
    answer = {
        "path": str(path),
        "version": version,
        "implementation": implementation,
        "has_venv": has_venv,
        "has_headers": has_headers,
    }
    return script(path, f"echo '{json.dumps(answer)}'\n")


def ros_prefix(folder, version="3.12"):
    """A prefix that has rclpy as an installed ROS 2 has it."""
    (folder / "lib" / f"python{version}" / "site-packages" / "rclpy").mkdir(parents=True)
    return folder


def sourced(prefix, distro="jazzy"):
    return {"ROS_DISTRO": distro, "AMENT_PREFIX_PATH": str(prefix), "PATH": os.defpath}


def workspace_copy(folder):
    """A workspace with the scripts and the requirements of this one, and no packages."""
    for name in ("scripts", "requirements"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def run_setup(root, *, step="setup", **env):
    """Run the set-up as a person does, with ``env`` alone as its environment."""
    return subprocess.run(
        [sys.executable, str(root / "scripts" / "setup_env.py"), step],
        env={"HOME": str(root), **{name: str(value) for name, value in env.items()}},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def assert_one_line_error(done, *words):
    assert done.returncode == 1
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0], lines[0]


@pytest.fixture
def no_running_python(monkeypatch):
    """The Python that runs the tests, and the machine's own, are not among the candidates."""
    monkeypatch.setattr(machine.sys, "base_prefix", "/nonexistent")
    monkeypatch.setattr(machine, "DEBIAN_PYTHON", "/nonexistent/python3")


# ---- which ROS


def test_a_sourced_jazzy_is_found_behind_an_overlay(tmp_path):
    prefix = ros_prefix(tmp_path / "jazzy")
    environ = sourced(f"{tmp_path / 'overlay'}:{prefix}")
    assert machine.find_ros(environ) == machine.Ros(prefix, "3.12")


@pytest.mark.parametrize("distro", ["humble", "kilted", "rolling"])
def test_another_distribution_is_rejected_by_name(tmp_path, distro):
    with pytest.raises(SetupError, match=f"'{distro}' is sourced.*'jazzy'"):
        machine.find_ros(sourced(ros_prefix(tmp_path), distro))


# ---- which Python


def test_the_first_supported_python_on_path_is_taken(tmp_path, no_running_python):
    fake_python(tmp_path / "old" / "python3", "3.9")
    fake_python(tmp_path / "new" / "python3.11", "3.11")
    environ = {"PATH": f"{tmp_path / 'old'}:{tmp_path / 'new'}", "HOME": str(tmp_path)}
    assert machine.choose(environ, None).path == str(tmp_path / "new" / "python3.11")


def test_pyenv_is_searched_and_what_does_not_fit_is_passed_over(tmp_path, no_running_python):
    fake_python(tmp_path / ".pyenv" / "versions" / "3.12.4" / "bin" / "python3.12", "3.12")
    fake_python(tmp_path / "env" / "bin" / "python3.11", "3.11")
    (tmp_path / "env" / "pyvenv.cfg").touch()
    script(tmp_path / "broken" / "python3.12", "exit 1\n")
    environ = {"PATH": f"{tmp_path / 'env' / 'bin'}:{tmp_path / 'broken'}", "HOME": str(tmp_path)}
    assert ".pyenv" in machine.choose(environ, None).path


@pytest.mark.parametrize(
    ("lack", "word"),
    [
        ({"has_venv": False}, r"python3\.12-venv"),
        ({"has_headers": False}, r"python3\.12-dev"),
        ({"implementation": "pypy"}, "CPython"),
    ],
)
def test_a_python_that_lacks_a_part_is_told_with_the_remedy(
    tmp_path, no_running_python, lack, word
):
    fake_python(tmp_path / "python3.12", "3.12", **lack)
    environ = {"PATH": str(tmp_path), "HOME": str(tmp_path)}
    with pytest.raises(SetupError, match=word):
        machine.choose(environ, None)


@pytest.mark.parametrize(
    ("version", "word"), [("3.10", r"is Python 3\.10.*3\.12 or 3\.11"), (None, "not a Python")]
)
def test_an_unfit_galen_python_is_rejected(tmp_path, version, word):
    named = tmp_path / "mine"
    if version:
        fake_python(named, version)
    with pytest.raises(SetupError, match=word):
        machine.choose({"GALEN_PYTHON": str(named)}, None)


def test_with_ros_only_its_own_version_is_taken(tmp_path, no_running_python):
    found = machine.Ros(ros_prefix(tmp_path / "jazzy"), "3.12")
    fake_python(tmp_path / "python3", "3.11")
    fake_python(tmp_path / "jazzy" / "bin" / "python3", "3.12")
    environ = {"PATH": str(tmp_path), "HOME": str(tmp_path)}
    assert machine.choose(environ, found).path == str(tmp_path / "jazzy" / "bin" / "python3")


# ---- what has to be on the machine


def fill_path(folder, names):
    for name in names:
        script(folder / name, "")
    return {"PATH": str(folder)}


@pytest.mark.parametrize(
    ("present", "missing"),
    [
        ([], "C compiler"),
        (["gcc"], r"C\+\+ compiler"),
        (["cc", "g++"], "CMake"),
        (["clang", "clang++", "cmake"], "make"),
    ],
)
def test_the_first_missing_tool_is_named_with_its_package(tmp_path, present, missing):
    with pytest.raises(SetupError, match=rf"no {missing} found.*apt install"):
        machine.check_tools(fill_path(tmp_path, present))


def test_all_tools_present_is_fine(tmp_path):
    environ = fill_path(tmp_path, ["gcc", "g++", "cmake", "make"])
    machine.check_tools(environ)
    with pytest.raises(SetupError, match="CXX=icpc is not on PATH"):
        machine.check_tools({**environ, "CXX": "icpc"})


# ---- what is installed


def test_every_requirement_is_pinned_once_and_ros_is_jazzy():
    groups = ("uv", *environment.GROUPS, *environment.OPTIONAL_GROUPS)
    pins = {group: read_pins(REQUIREMENTS / f"{group}.txt") for group in groups}
    names = [name for group in pins.values() for name in group]
    assert len(names) == len(set(names))
    assert pins["ros"]["ros-rclpy"].split()[0] == environment.RCLPY_VERSION
    # What the demonstration installs has none of the developer's tools.
    assert {"pytest", "mypy", "ruff", "mujoco"} <= set(pins["dev"])
    assert [group for group in groups if "torch" in pins[group]] == ["networks"]


@pytest.mark.parametrize("line", ["numpy", "numpy>=2", "numpy==", "numpy==2.4.6"])
def test_a_line_without_an_exact_pin_and_a_hash_is_rejected(tmp_path, line):
    path = tmp_path / "x.txt"
    path.write_text(f"# comment\n{line}\n")
    with pytest.raises(SetupError, match=rf"x\.txt: '{line}' is not"):
        read_pins(path)


def test_an_entry_of_several_lines_is_one_pin(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text(
        "Py_YAML==6.0 \\\n    --hash=sha256:aa \\\n    --hash=sha256:bb\npin==4 --hash=sha256:c\n"
    )
    assert read_pins(path) == {
        "py-yaml": "6.0 --hash=sha256:aa --hash=sha256:bb",
        "pin": "4 --hash=sha256:c",
    }


def test_with_ros_what_it_brings_stays():
    pins = {
        "runtime": {"numpy": "2.4.6", "pin": "4.1.0", "pyyaml": "6.0.3"},
        "build": {"setuptools": "79.0.1", "empy": "4.2.1"},
        "ros": {"ros-rclpy": "7.1.6"},
    }
    found = machine.Ros(Path("/opt/ros/jazzy"), "3.12")
    installed = {"numpy": "1.26.4", "PyYAML": "6.0.1", "setuptools": "68.1.2"}
    assert to_install(pins, installed, found) == {"pin": "4.1.0", "empy": "4.2.1"}
    assert set(to_install(pins, {}, None)) == {n for group in pins.values() for n in group}


def test_uv_takes_pips_settings_and_its_own_go_first():
    printed = """:env:.cert='/etc/ca.crt'
:env:.find-links='/a /b'
global.cert='/old.crt'
global.index-url='https://global.example/simple'
global.extra-index-url='\\nhttps://one.example\\nhttps://two.example'
install.index-url='https://install.example/simple'
install.user='true'
"""
    assert environment.uv_settings(printed, {"UV_DEFAULT_INDEX": "https://mine.example"}) == {
        "SSL_CERT_FILE": "/etc/ca.crt",
        "UV_FIND_LINKS": "/a,/b",
        "UV_INDEX": "https://one.example https://two.example",
    }
    settings = environment.uv_settings(printed, {})
    assert settings["UV_DEFAULT_INDEX"] == "https://install.example/simple"


def test_pip_installs_what_uv_can_not(ready):
    calls = ready.root / "calls"
    for name in ("uv", "python"):
        script(ready.path / "bin" / name, f'echo {name} "$@" >> {calls}; [ {name} = python ]\n')
    ready.log.parent.mkdir()
    ready._install({"pin": "4.1.0 --hash=sha256:aa"})
    said = calls.read_text().splitlines()
    assert [line.split()[0] for line in said] == ["python", "uv", "python"]
    assert "-m pip install --no-deps" in said[2]
    assert (ready.path / "galen_wanted.txt").read_text() == "pin==4.1.0 --hash=sha256:aa\n"


# ---- downloads that fail


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (
            "WARNING: Retrying ... NewConnectionError('...')\n"
            "ERROR: No matching distribution found for pin==4.1.0",
            "did not answer",
        ),
        (
            "ERROR: Could not find a version that satisfies pin==4.1.0 (from versions: none)\n"
            "ERROR: No matching distribution found for pin==4.1.0",
            "did not answer or does not have pin==4.1.0",
        ),
        ("ERROR: Could not install: [Errno 28] No space left on device", "disk is full"),
        ("ERROR: something else", "something else"),
        ("", "pip failed"),
    ],
)
def test_pips_output_is_put_in_a_few_words(log, words):
    assert words in explain_pip(log)


@pytest.mark.slow
def test_a_failing_download_is_one_line_and_leaves_no_good_environment(tmp_path):
    root = workspace_copy(tmp_path / "ws")
    closed_port = "http://127.0.0.1:9/simple"
    done = run_setup(
        root,
        PATH=os.environ["PATH"],
        GALEN_PYTHON=Path(sys.base_prefix, "bin", "python{}.{}".format(*sys.version_info[:2])),
        PIP_INDEX_URL=closed_port,
        PIP_RETRIES=0,
        PIP_NO_CACHE_DIR=1,
        PIP_CONFIG_FILE=os.devnull,
    )
    assert_one_line_error(done, "did not answer", str(root / "log" / "setup.log"))
    assert (root / "log" / "setup.log").stat().st_size
    assert not Environment(root, {}).is_ready()


# ---- what a second run takes for good


@pytest.fixture
def ready(tmp_path):
    """An environment with the stamp of a finished one."""
    root = workspace_copy(tmp_path / "ws")
    found = Environment(root, {"PATH": os.defpath})
    script(found.python, "")
    (found.path / "pyvenv.cfg").touch()
    found._write_stamp(machine.Interpreter("python3", "3.12", "cpython", True, True))
    return found


def test_a_finished_environment_is_kept(ready):
    assert ready.is_ready()
    ready.make()  # would fail on the empty .venv if it looked further


@pytest.mark.parametrize("group", environment.OPTIONAL_GROUPS)
def test_an_optional_group_is_added_once_and_makes_nothing_anew(ready, group):
    """The environment's Python here writes down what it is called with, and has nothing in it."""
    calls = ready.root / "calls"
    script(ready.python, f'echo "$@" >> {calls}; cat {ready.path}/galen_wanted.txt >> {calls}\n')
    ready.add(group)
    said = calls.read_text()
    pins = read_pins(ready.root / "requirements" / f"{group}.txt")
    assert all(f"{name}=={version}\n" in said for name, version in pins.items())
    assert f"-c {environment.OPTIONAL_GROUPS[group][0]}\n" in said
    ready.add(group)
    assert calls.read_text() == said
    assert ready.is_ready()
    path = ready.root / "requirements" / f"{group}.txt"
    path.write_text(path.read_text() + "# changed\n")
    assert ready.is_ready()
    ready.add(group)
    assert calls.read_text() == said + said


def test_a_broken_stamp_or_a_gone_python_is_not_ready(ready):
    stamp = ready.path / environment.STAMP_NAME
    text = stamp.read_text()
    stamp.write_text(text[:10])
    assert not ready.is_ready()
    stamp.write_text(text)
    assert ready.is_ready()
    ready.python.unlink()
    assert not ready.is_ready()


def test_a_folder_that_is_no_environment_is_not_removed(tmp_path):
    root = workspace_copy(tmp_path / "ws")
    keep = root / ".venv" / "thesis.txt"
    keep.parent.mkdir()
    keep.write_text("mine")
    done = run_setup(root, PATH=os.environ["PATH"])
    assert_one_line_error(done, "not a Python environment")
    assert keep.read_text() == "mine"


def test_paths_of_an_earlier_source_are_left_out(tmp_path):
    mine = tmp_path / ".venv"
    cleaned = environment.clean_environ(
        {
            "AMENT_PREFIX_PATH": f"{tmp_path}/install/galen_ros:/opt/ros/jazzy:{mine}",
            "PATH": f"{mine}/bin:/usr/bin",
            "PYTHONPATH": f"{tmp_path}/build/galen_ros",
            "VIRTUAL_ENV": str(mine),
            "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
        },
        tmp_path,
    )
    assert cleaned == {"AMENT_PREFIX_PATH": "/opt/ros/jazzy", "PATH": "/usr/bin"}


def waits(root, lock_kind):
    """Whether a set-up waits while this process holds the workspace; and what it says then."""
    with (root / ".workspace.lock").open("a") as held:
        fcntl.flock(held, lock_kind)
        second = subprocess.Popen(
            [sys.executable, str(root / "scripts" / "setup_env.py"), "setup"],
            env={"HOME": str(root), "PATH": str(root), "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with contextlib.ExitStack() as stack:
            stack.callback(second.kill)
            waited = "Waiting" in second.stdout.readline()
            assert not waited or second.poll() is None
            fcntl.flock(held, fcntl.LOCK_UN)
            _, errors = second.communicate(timeout=60)
    return waited, errors


@pytest.mark.parametrize("lock_kind", [fcntl.LOCK_EX, fcntl.LOCK_SH])
def test_none_makes_the_environment_beside_another_run(tmp_path, lock_kind):
    waited, errors = waits(workspace_copy(tmp_path / "ws"), lock_kind)
    assert waited
    assert "C compiler" in errors  # it went on, to this


# ---- the wheels' repair


def test_the_builders_folders_become_the_environments(tmp_path):
    path = tmp_path / "share" / "std_msgs" / "cmake" / "export.cmake"
    path.parent.mkdir(parents=True)
    builder = "/opt/python/cp312-cp312"
    path.write_text(
        f'INCLUDES "{builder}/include/python3.12;'
        f'{builder}/lib/python3.12/site-packages/numpy/_core/include;${{_IMPORT_PREFIX}}/include"\n'
    )
    cached = tmp_path / "cache.cmake"
    cached.hardlink_to(path)
    other = path.with_name("other.cmake")
    other.write_text("find_package(std_msgs)\n")
    before = other.stat().st_mtime_ns
    assert repair_wheels(tmp_path, "/py/include", "/np/include") == 1
    assert path.read_text() == 'INCLUDES "/py/include;/np/include;${_IMPORT_PREFIX}/include"\n'
    assert builder in cached.read_text()
    assert other.stat().st_mtime_ns == before
    assert repair_wheels(tmp_path, "/py/include", "/np/include") == 0


# ---- when the build runs


@pytest.fixture
def packages(tmp_path):
    """A workspace with one package."""
    for name in ("setup.py", "package.xml", "pkg/node.py", "test/test_a.py", "launch/a.launch.py"):
        path = tmp_path / "pkg" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("first\n")
    (tmp_path / "pkg" / "msg").mkdir()
    (tmp_path / "pkg" / "msg" / "A.msg").write_text("float64 x\n")
    return tmp_path


@pytest.mark.parametrize(
    ("builds", "names"),
    [
        (True, ["setup.py", "package.xml", "msg/A.msg"]),  # changed
        (True, ["msg/B.msg", "launch/b.launch.py", "config/a.yaml"]),  # new, and installed
        (False, ["pkg/node.py", "pkg/new.py", "pkg/__pycache__/node.pyc"]),
        (False, ["test/test_b.py", "README.md", "launch/a.launch.py"]),
    ],
)
def test_only_what_is_not_live_asks_for_a_build(packages, builds, names):
    for name in names:
        before = build.source_key(packages)
        path = packages / "pkg" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("second\n")
        assert (build.source_key(packages) != before) == builds, name


def fake_cmake(found, text):
    """Let cmake, in the environment's bin, do ``text``; the environment's python does nothing."""
    script(found.path / "bin" / "cmake", f'echo "$@" >> "{found.root}/runs"\n{text}')


def runs(found):
    path = found.root / "runs"
    return len(path.read_text().splitlines()) if path.exists() else 0


def test_the_build_runs_once_and_after_a_change(ready):
    package = ready.root / "pkg" / "package.xml"
    package.parent.mkdir()
    package.write_text("first")
    gone = ready.root / "install" / "gone"
    gone.mkdir(parents=True)
    fake_cmake(ready, "")
    build.build(ready)
    build.build(ready)
    assert runs(ready) == 2  # it configures, then it compiles
    assert not gone.exists()
    package.write_text("second")
    build.build(ready)
    assert runs(ready) == 4


def test_a_failed_build_names_the_step_and_runs_again(ready, capsys):
    fake_cmake(ready, 'case "$1" in --build) echo "x.msg: bad type"; exit 2;; esac\n')
    for number in (1, 2):
        with pytest.raises(SetupError, match=r"compiling galen_msgs failed; see log/build\.log"):
            build.build(ready)
        assert runs(ready) == 2 * number
    assert "x.msg: bad type" in capsys.readouterr().out


def test_packages_are_installed_as_links_that_run(tmp_path):
    """In a path with a blank, which no `#!` can name."""
    root = tmp_path / "my workspace"
    files = {
        "setup.py": """from setuptools import find_packages, setup
setup(name="pkg", version="1.2", packages=find_packages(),
      data_files=[("share/pkg/config", ["config/a.yaml"])],
      entry_points={"console_scripts": ["node = pkg.run:main"]})
""",
        "config/a.yaml": "a: 1\n",
        "pkg/__init__.py": "",
        "pkg/run.py": "import sys\ndef main():\n    print('runs', sys.argv[1:])\n    return 3\n",
    }
    for name, text in files.items():
        path = root / "pkg" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    subprocess.run([sys.executable, ROOT / "scripts/workspace/link.py", root], check=True)
    install = root / "install"
    assert (install / "share/pkg/config/a.yaml").resolve() == root / "pkg/config/a.yaml"
    done = subprocess.run(
        [install / "lib/pkg/node", "x y"],
        env={"PATH": os.defpath, "PYTHONPATH": str(install / "python")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (3, "runs ['x y']\n")
    code = "import importlib.metadata as m; print(m.version('pkg'), *m.entry_points(name='node'))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": str(install / "python")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "1.2" in done.stdout
    assert "pkg.run:main" in done.stdout


# ---- the stand-in for `ros2 run`, and the shell's way in


@pytest.fixture
def prefixes(tmp_path):
    """Two prefixes that have the same package, the first with fewer executables."""
    for name, programs in (("overlay", ["node"]), ("base", ["node", "tool"])):
        marker = tmp_path / name / "share" / "ament_index" / "resource_index" / "packages" / "pkg"
        marker.parent.mkdir(parents=True)
        marker.touch()
        for program in programs:
            script(tmp_path / name / "lib" / "pkg" / program, f'echo {name} {program} "$@"\n')
    (tmp_path / "base" / "lib" / "pkg" / "readme.txt").touch()
    return [str(tmp_path / "overlay"), str(tmp_path / "base")]


def test_an_unknown_executable_or_package_is_told(prefixes):
    with pytest.raises(NotFoundError, match=r"it has: node, tool$"):
        find_executable(prefixes, "pkg", "readme.txt")
    with pytest.raises(NotFoundError, match="package 'other' not found"):
        find_executable(prefixes, "other", "node")


def stand_in(*arguments, prefixes=()):
    return subprocess.run(
        [str(ROOT / "scripts" / "fallback_bin" / "ros2"), *arguments],
        env={
            "PATH": f"{Path(sys.executable).parent}:{os.defpath}",
            "AMENT_PREFIX_PATH": ":".join(prefixes),
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        ([], 0, "usage: ros2 run"),
        (["run", "pkg"], 1, "name an executable"),
        (["topic", "list"], 1, "needs a full ROS 2 Jazzy"),
    ],
)
def test_the_stand_in_tells_what_it_can(arguments, code, word):
    done = stand_in(*arguments)
    assert done.returncode == code
    assert word in done.stdout + done.stderr


@pytest.mark.parametrize("file", ["scripts/env.sh", "install/setup."])
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_shell_enters_from_any_folder_and_twice(tmp_path, shell, file):
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell} on this machine")
    file = file + shell if file.endswith(".") else file
    code = f"""
        set -eu
        source '{ROOT}/{file}'; source '{ROOT}/{file}'
        case $- in *u*) echo nounset kept ;; esac
        command -v python
        echo "$PATH" | tr : '\\n' | grep -c '/.venv/bin'
        python -c 'import galen_msgs.msg, galen_model, rclpy; print("imports")'
        ros2 run galen_gravcomp evaluate --help > help.txt && echo runs
    """
    done = subprocess.run(
        [program, "-c", code],
        cwd=tmp_path,
        env={"PATH": os.defpath, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    expected = ["nounset kept", str(ROOT / ".venv" / "bin" / "python"), "1", "imports", "runs"]
    assert done.stdout.splitlines() == expected
    assert "usage" in (tmp_path / "help.txt").read_text()


def test_a_workspace_on_the_environment_alone_sees_nothing_that_make_built(tmp_path):
    done = subprocess.run(
        ["bash", "-c", f"source '{ROOT}/.venv/local_setup.bash'; env"],
        cwd=tmp_path,
        env={"PATH": os.defpath},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"VIRTUAL_ENV={ROOT}/.venv" in done.stdout
    assert f"{ROOT}/install" not in done.stdout
