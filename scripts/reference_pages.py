# SPDX-License-Identifier: Apache-2.0
"""MkDocs hook: make the reference from the code, and order the pages by their folders.

Nothing of it is committed. It needs the built packages: the nodes' parameters are read from their
classes, and every command is asked for its `--help`.
"""

from __future__ import annotations

import importlib
import os
import posixpath
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from galen_common.parameters import markdown_table
from galen_diagnosis.effects.registry import RECORDS
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
SECTIONS = ("tutorials", "how-to", "reference", "explanation", "results")
OWN_SECTION = {"index.md": "", "readme.md": "", "architecture.md": "explanation"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")
EXECUTABLE = re.compile(r"\"(\w+) = ")


def readme_pages() -> dict[str, str]:
    """Return page by file, both relative to their folders, of the files outside of `docs/`."""
    readmes = [*ROOT.glob("[!.]*/README.md"), *ROOT.glob("galen_*/galen_*/*/README.md")]
    pages = {
        str(path.relative_to(ROOT)): f"reference/packages/{path.parent.name}.md"
        for path in sorted(readmes)
    }
    return pages | {"CONTRIBUTING.md": "reference/contributing.md", "README.md": "readme.md"}


def relinked(text: str, source: str, page: str) -> str:
    """Make the links of a file work on its page.

    Args:
        text: the file's Markdown.
        source: the file, relative to the repository.
        page: its page, relative to `docs/`.

    Returns:
        The Markdown; a link to a file that has no page is only its label.

    """
    pages = readme_pages()

    def replaced(match: re.Match[str]) -> str:
        picture, label, target, anchor = match.groups(default="")
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in pages:
            uri = pages[path]
        elif path.startswith("docs/"):
            uri = path.removeprefix("docs/")
        elif (ROOT / path).exists():
            return label
        else:
            return match.group()  # mkdocs names it as broken
        return f"{picture}[{label}]({posixpath.relpath(uri, posixpath.dirname(page))}{anchor})"

    return LINK.sub(replaced, text)


def node_page(name: str, node: dict[str, Any]) -> str:
    """Make the page of a node: topics, services, actions and parameters."""
    lines = [f"# {name}", "", f"Package `{node['package']}`.", "", "## Topics, services, actions"]
    lines += ["", "| name | type | direction | meaning |", "|---|---|---|---|"]
    lines += [f"| `{row[0]}` | {' | '.join(row[1:])} |" for row in node["interfaces"]]
    if node["parameters"]:
        lines += ["", "## Parameters"]
    for path in node["parameters"]:
        module, _, cls = path.rpartition(".")
        lines += ["", markdown_table(getattr(importlib.import_module(module), cls))]
    return "\n".join(lines) + "\n"


def command_page(package: str, commands: list[str]) -> str:
    """Make the page of a package's commands: what each answers to `--help`."""
    lines = [f"# Commands of {package}"]
    for command in commands:
        help_text = subprocess.run(
            ["ros2", "run", package, command, "--help"],
            env={**os.environ, "COLUMNS": "88"},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        lines += ["", f"## {command}", "", "```text", help_text.strip(), "```"]
    return "\n".join(lines) + "\n"


def definitions_page() -> str:
    """Make the page of the messages', services' and actions' definitions."""
    lines = ["# Definitions of galen_msgs"]
    for path in sorted((ROOT / "galen_msgs").glob("[msa]*/*.[msa]*")):
        lines += ["", f"## {path.stem}", "", "```text", path.read_text().strip(), "```"]
    return "\n".join(lines) + "\n"


def simulators_page() -> str:
    """Make the page of what a diagnosis' effects are in other simulators, by their records."""
    lines = ["# Effects in MuJoCo and Gazebo", "", "| effect | MuJoCo | Gazebo |", "|---|---|---|"]
    for record in RECORDS.values():
        lacking = "" if record.in_mujoco else "no such thing: "
        lines.append(f"| `{record.name}` | {lacking}{record.mujoco} | {record.gazebo} |")
    return "\n".join(lines) + "\n"


def api_pages() -> Iterator[tuple[str, str]]:
    """Make a page of each sub-package of galen_model, and one of its own modules."""
    top = ROOT / "galen_model" / "galen_model"
    for folder in [top, *sorted(path.parent for path in top.glob("*/**/__init__.py"))]:
        name = ".".join(folder.relative_to(top.parent).parts)
        modules = [path.stem for path in sorted(folder.glob("*.py")) if path.stem[0] != "_"]
        blocks = "\n".join(f"::: {name}.{module}\n" for module in modules)
        if modules:
            yield f"reference/python/{name}.md", f"# {name}\n\n{blocks}"


def reference() -> Iterator[tuple[str, str]]:
    """Make the reference's pages: (page relative to `docs/`, its Markdown)."""
    nodes = yaml.safe_load((ROOT / "docs" / "interfaces.yaml").read_text())
    for name, node in nodes.items():
        yield f"reference/nodes/{name}.md", node_page(name, node)
    for setup in sorted(ROOT.glob("*/setup.py")):
        names = EXECUTABLE.findall(setup.read_text())
        if commands := sorted(name for name in names if not name.endswith("_node")):
            package = setup.parent.name
            yield f"reference/commands/{package}.md", command_page(package, commands)
    yield "reference/definitions.md", definitions_page()
    yield "reference/simulators.md", simulators_page()
    yield from api_pages()
    for source, page in readme_pages().items():
        yield page, relinked((ROOT / source).read_text(), source, page)


def tree(pages: list[str], folder: str) -> list[Any]:
    """Return the navigation of a folder: its pages, then its folders by name."""
    inside = [page for page in pages if page.startswith(f"{folder}/")]
    own = [page for page in inside if posixpath.dirname(page) == folder]
    folders = sorted({page[len(folder) + 1 :].split("/")[0] for page in inside if page not in own})
    below: list[Any] = [{name.capitalize(): tree(inside, f"{folder}/{name}")} for name in folders]
    return [*sorted(own), *below]


def on_files(files: Files, config: Any) -> Files:
    """Add the reference, and write the navigation."""
    for page, text in reference():
        files.append(File.generated(config, page, content=text))
    pages = [file.src_uri for file in files.documentation_pages()]
    own = {page: "results" for page in pages if "/" not in page} | OWN_SECTION
    config.nav = ["index.md", {"README": "readme.md"}]
    for name in SECTIONS:
        first = sorted(page for page, section in own.items() if section == name)
        config.nav.append({name.capitalize(): [*first, *tree(pages, name)]})
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Make the links that lead out of `docs/` work."""
    if page.file.generated_by:
        return markdown
    return relinked(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)
