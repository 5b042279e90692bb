# SPDX-License-Identifier: Apache-2.0
"""Layers: which modules may import ROS, and which package imports which."""

import ast
import functools
import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("galen_*/setup.py"))

# The modules of these packages, and of a package's folder `ros`, may need rclpy or messages. All
# others are pure: they work, and are tested, without ROS.
ROS_PACKAGES = {"galen_ros", "galen_bringup"}
ROS_ROOTS = {"rclpy", "rcl_interfaces", "ament_index_python", "launch", "launch_ros", "std_srvs"}

_SHARED = {"galen_model", "galen_common", "galen_msgs", "galen_ros", "galen_bags"}
MAY_IMPORT = {
    "galen_model": set(),
    "galen_common": {"galen_model"},
    "galen_ros": {"galen_model", "galen_common", "galen_msgs"},
    "galen_bags": _SHARED,
    "galen_sim_driver": _SHARED,
    "galen_gravcomp": _SHARED,
    "galen_calibration_behavior": _SHARED,
    "galen_deflection": _SHARED,
    "galen_diagnosis": _SHARED | {"galen_sim_driver"},
    "galen_panel": {*PACKAGES, "galen_msgs"} - {"galen_bringup"},
    "galen_bringup": {*PACKAGES, "galen_msgs"},
}


@functools.cache
def modules():
    """All modules of the packages by name: {name: file}."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package / package).rglob("*.py")):
            parts = path.relative_to(ROOT / package).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def names_of(node):
    """What an import statement may load: modules, and names that may be modules."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    return {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}


def is_block(node):
    return isinstance(node, (ast.stmt, ast.excepthandler, ast.match_case))


@functools.cache
def imported(name):
    """What a module imports: when it is loaded, and anywhere in it."""
    when_loaded, anywhere = set(), set()
    waiting = [(ast.parse(modules()[name].read_text(encoding="utf-8")), True)]
    while waiting:
        node, loads = waiting.pop()
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            assert not getattr(node, "level", 0), f"{name}: relative import"
            anywhere |= names_of(node)
            when_loaded |= names_of(node) if loads else set()
        in_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        only_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        loads = loads and not in_function and not only_types
        waiting += [(child, loads) for child in ast.iter_child_nodes(node) if is_block(child)]
    return when_loaded, anywhere


def is_ros(name):
    root = name.partition(".")[0]
    return root in ROS_ROOTS or root.endswith(("_msgs", "_interfaces"))


def may_import_ros(name):
    package, _, inside = name.partition(".")
    return package in ROS_PACKAGES or inside.partition(".")[0] == "ros"


@functools.cache
def loaded_by(name):
    """The imports that loading a module takes, with those of the modules that it loads."""
    found, seen, waiting = set(), set(), [name]
    while waiting:
        module = waiting.pop()
        parts = module.split(".")
        for parent in (".".join(parts[: k + 1]) for k in range(len(parts))):
            if parent in seen or parent not in modules():
                continue
            seen.add(parent)
            names = imported(parent)[0]
            found |= {(parent, one) for one in names}
            waiting += names
    return found


def ros_on_loading(name):
    return {f"{module} imports {one}" for module, one in loaded_by(name) if is_ros(one)}


@pytest.mark.parametrize("package", PACKAGES)
def test_pure_modules_load_without_ros(package):
    pure = [m for m in modules() if m.split(".")[0] == package and not may_import_ros(m)]
    assert pure or package in ROS_PACKAGES
    assert {name: ros_on_loading(name) for name in pure if ros_on_loading(name)} == {}


def test_pure_modules_name_no_ros_import_anywhere():
    pure = [name for name in modules() if not may_import_ros(name)]
    found = {name: {one for one in imported(name)[1] if is_ros(one)} for name in pure}
    assert {name: names for name, names in found.items() if names} == {}


def test_galen_ros_holds_nothing_that_needs_no_ros():
    own = [name for name, path in modules().items() if path.name != "__init__.py"]
    pure = [name for name in own if name.startswith("galen_ros.") and not ros_on_loading(name)]
    assert pure == []


def test_packages_import_only_layers_below():
    """A capability imports no other one, but for the diagnosis the simulated arm."""
    assert set(PACKAGES) == set(MAY_IMPORT)
    wrong = {
        name: sorted(one for one in names_of_packages(name) if one not in allowed)
        for name in modules()
        for allowed in [MAY_IMPORT[name.split(".")[0]] | {name.split(".")[0]}]
    }
    assert {name: names for name, names in wrong.items() if names} == {}


def names_of_packages(name):
    """The suite's packages that a module imports."""
    roots = {one.split(".")[0] for one in imported(name)[1]}
    return {root for root in roots if root.startswith("galen_")}


# A rosdep key, or a package on PyPI, by the module that is imported; of others both are its name.
DECLARED_AS = {
    "backports": "backports.zstd", "compression": "backports.zstd", "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib", "numpy": "python3-numpy", "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip", "scipy": "python3-scipy", "tqdm": "python3-tqdm",
    "uvicorn": "python3-uvicorn", "yaml": "python3-yaml",
}  # fmt: skip


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_imported_is_declared(package):
    """package.xml has it as a key, or as a comment where rosdep has none; setup.py these, too."""
    xml = (ROOT / package / "package.xml").read_text(encoding="utf-8")
    keys = set(re.findall("<exec_depend>(.*?)</exec_depend>", xml))
    of_pypi = re.findall(r"<!-- (No rosdep key|Optional), from PyPI.*?: (.*?) -->", xml)
    from_pypi = {name for _, names in of_pypi for name in names.split(", ")}
    own = [name for name in modules() if name.split(".")[0] == package]
    roots = {one.split(".")[0] for name in own for one in imported(name)[1]}
    needed = {DECLARED_AS.get(r, r) for r in roots - sys.stdlib_module_names - {package}}
    assert needed <= keys | from_pypi
    setup = (ROOT / package / "setup.py").read_text(encoding="utf-8")
    assert {name for name in from_pypi if f'"{name}' not in setup} == set()


HEAVY = {"dask", "distributed", "fsspec", "mujoco", "nicegui", "pyarrow", "s3fs", "torch"}


def test_compensation_alone_brings_nothing_heavy():
    """Neither by the packages that galen_gravcomp needs, nor when its executables start."""
    needed, waiting = set(), ["galen_gravcomp"]
    while waiting:
        package = waiting.pop()
        needed.add(package)
        folder = ROOT / package
        if folder.is_dir():
            xml = (folder / "package.xml").read_text(encoding="utf-8")
            waiting += set(re.findall("<(?:exec_)?depend>(.*?)<", xml)) - needed
            found = re.search(r"<!-- No rosdep key, from PyPI: (.*?) -->", xml)
            needed |= set(found[1].split(", ")) if found else set()
    assert {"galen_bags", "apsw", "python3-numpy"} <= needed and not HEAVY & needed
    executables = (ROOT / "galen_gravcomp/galen_gravcomp/executables.py").read_text()
    started = re.findall(r"\bgalen_gravcomp\.[\w.]+", executables)
    assert len(started) == 3
    roots = {one.split(".")[0] for module in started for _, one in loaded_by(module)}
    assert "numpy" in roots and not (HEAVY | {"matplotlib"}) & roots


SLOW_TO_LOAD = re.compile(r"scipy\.(interpolate|ndimage|optimize|signal|stats)\b")


@pytest.mark.parametrize(
    "module",
    [*(name for name in modules() if re.search(r"\.ros\.\w*node$", name)), "galen_panel.server"],
)
def test_what_runs_on_the_robot_starts_without_the_slow_parts_of_scipy(module):
    """Each takes 0.2 to 1 s; `import scipy` loads them when they are used."""
    found = {one for one in loaded_by(module) if SLOW_TO_LOAD.match(one[1])}
    assert found == set()


def installed_with(package):
    """What a package's setup.py has from PyPI: (always, by extra)."""
    calls = ast.walk(ast.parse((ROOT / package / "setup.py").read_text(encoding="utf-8")))
    keywords = {one.arg: one.value for one in calls if isinstance(one, ast.keyword)}
    extras = keywords.get("extras_require")
    always = set(ast.literal_eval(keywords["install_requires"])) - {"setuptools"}
    return always, ast.literal_eval(extras) if extras else {}


def test_the_extras_are_those_of_the_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {"plots": ["matplotlib"], "panel": sorted(installed_with("galen_panel")[0])}
    for package in PACKAGES:
        own = installed_with(package)[1]
        assert own.pop("test") == ["pytest"]  # by which `colcon test` chooses it
        extras |= own
        if package != "galen_panel":
            assert installed_with(package)[0] <= set(project["dependencies"])
    assert project["optional-dependencies"] == extras


def test_the_python_package_declares_what_it_imports():
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = content["project"]
    given = chain(project["dependencies"], *project["optional-dependencies"].values())
    named = {re.match(r"[\w.-]+", one)[0] for one in given}
    of_pypi = {"pinocchio": "pin", "yaml": "pyyaml", "backports": "backports.zstd"}
    inside = set(content["tool"]["setuptools"]["packages"]["find"]["where"])
    own = [n for n in modules() if n.split(".")[0] in inside and not may_import_ros(n)]
    roots = {one.split(".")[0] for name in own for one in imported(name)[1]}
    others = roots - sys.stdlib_module_names - set(PACKAGES) - {"compression", "galen_msgs"}
    assert {of_pypi.get(one, one) for one in others} <= named


def public_functions(node):
    """Functions and methods without an underscore, outside of functions and private classes."""
    for child in node.body:
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            if child.name.startswith("_"):
                continue
            if isinstance(child, ast.ClassDef):
                yield from public_functions(child)
            else:
                yield child


@pytest.mark.parametrize("package", [*PACKAGES, "galen_validation"])
def test_public_functions_document_their_arguments(package):
    lacking = []
    for path in sorted((ROOT / package).rglob("*.py")):
        if "test" in path.relative_to(ROOT).parts:
            continue
        for function in public_functions(ast.parse(path.read_text(encoding="utf-8"))):
            known = function.args
            names = [one.arg for one in (*known.posonlyargs, *known.args, *known.kwonlyargs)]
            if {*names} - {"self", "cls"} and "Args:" not in (ast.get_docstring(function) or ""):
                lacking.append(f"{path.relative_to(ROOT)}:{function.lineno} {function.name}")
    assert lacking == []
