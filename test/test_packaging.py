# SPDX-License-Identifier: Apache-2.0
"""What a ROS index reads of the packages: licences, manifests, changelogs."""

import re
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml
from catkin_pkg.changelog import Changelog, populate_changelog_from_rst

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("galen_*/package.xml"))
SOURCES = {".css", ".js", ".py", ".sh"}
SPDX = re.compile(r"(#|//|/\*) SPDX-License-Identifier: Apache-2\.0( \*/)?")


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout")
def test_every_source_begins_with_its_licence():
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    lacking, sources = [], 0
    for name in filter(None, listed.split("\0")):
        path = ROOT / name
        if not path.is_file():
            continue  # deleted, and not committed yet
        script = not path.suffix and path.read_bytes().startswith(b"#!")
        if path.suffix in SOURCES or path.name in ("CMakeLists.txt", "Makefile") or script:
            sources += 1
            first = [*path.read_text(encoding="utf-8").splitlines(), "", ""]
            if not SPDX.fullmatch(first[first[0].startswith("#!")]):
                lacking.append(name)
    assert lacking == [] and sources > 600


@pytest.mark.parametrize("package", PACKAGES)
def test_manifest_and_setup_agree(package):
    manifest = ET.parse(ROOT / package / "package.xml").getroot()
    assert manifest.findtext("license") == "Apache-2.0"
    assert manifest.findtext("export/rosdoc2") == "rosdoc2.yaml"
    kind, content = yaml.safe_load_all((ROOT / package / "rosdoc2.yaml").read_text())
    assert kind == {"type": "rosdoc2 config", "version": 1}
    assert content["builders"] == [{"sphinx": {"name": package, "output_dir": ""}}]
    if package == "galen_msgs":
        return
    setup = (ROOT / package / "setup.py").read_text()
    maintainer = manifest.find("maintainer")
    for field, value in (
        ("version", manifest.findtext("version")),
        ("maintainer", maintainer.text),
        ("maintainer_email", maintainer.get("email")),
        ("license", "Apache-2.0"),
    ):
        assert f'{field}="{value}"' in setup, field


@pytest.mark.parametrize("package", PACKAGES)
def test_the_changelog_is_one_that_catkin_takes(package):
    """Its tools rename Forthcoming to the version when it is released."""
    text = (ROOT / package / "CHANGELOG.rst").read_text(encoding="utf-8")
    rule, title, *_ = text.splitlines()
    assert title == f"Changelog for package {package}" and rule == "^" * len(title)
    heading = "0.1.0 (2026-01-01)"
    released = text.replace("Forthcoming\n-----------", f"{heading}\n{'-' * len(heading)}")
    changelog = populate_changelog_from_rst(Changelog(package), released)
    versions = [(version, content) for version, _, content in changelog.foreach_version()]
    assert [version for version, _ in versions] == ["0.1.0"]
    assert list(versions[0][1][0])
