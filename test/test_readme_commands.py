# SPDX-License-Identifier: Apache-2.0
"""Commands of READMEs, tutorials and how-tos: files are there or marked, nodes are named."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
READMES = sorted(
    str(path.relative_to(ROOT))
    for path in (
        *ROOT.glob("README.md"),
        *ROOT.glob("*/README.md"),
        *ROOT.glob("galen_*/galen_*/**/README.md"),
        *ROOT.glob("docs/tutorials/*.md"),
        *ROOT.glob("docs/how-to/*.md"),
    )
)
# Files and bags of a command: what makes them, and what takes them.
MAKES = {
    "-o",
    "--output",
    "--plots",
    "--next",
    "--truth",
    "--write-bags",
    "--write-tool",
    ">",
}
TAKES = re.compile(
    r"ros2 run galen_\w+ (?:play|evaluate|drift|convert|diagnose\w*|train"
    r"|(?:calibrate|inertia|cable)_from_bag \w+) "
)
COMMAND = re.compile(r"(\$ )?(ros2|python) ")
FILE = re.compile(
    r"[\w./*-]+\.(?:csv|txt|json|yaml|mcap|bag)|(?:bags|tilt|sets|found|tools)/[\w./-]+"
)


def blocks(readme):
    """The blocks with commands: [(the text before it, its commands a line each)]."""
    found, section, code, fenced = [], [], [], False
    for line in [*(ROOT / readme).read_text().splitlines(), "."]:
        fence = line.startswith("```")
        if fenced or line.startswith("    ") or (code and not line and not fence):
            if not fence:
                code.append(line.strip())
        elif code:
            lines = re.sub(r" ?\\\n", " ", "\n".join(code)).split("\n")
            if any(COMMAND.match(one) for one in lines):
                found.append(("\n".join(section), [one for one in lines if one]))
            code = []
        fenced = fenced != fence
        if not fenced and not code:
            section = [line] if line.startswith("#") else [*section, line]
    return found


def arguments_of(line):
    """Its words that stand for files and bags: (those it takes, those it makes)."""
    words = shlex.split(line, comments=True)
    makes = {words[k + 1] for k, word in enumerate(words[:-1]) if word in MAKES}
    taken = {word for word in words if FILE.fullmatch(word.split(":=")[-1])}
    command = TAKES.match(line)
    if command:
        for word in shlex.split(line[command.end() :], comments=True):
            if word.startswith("-"):
                break
            taken.add(word)
    if "--tool-beside" in words:
        taken.discard(words[words.index("--tool-beside") + 1])  # a name to look for
    return {word.split(":=")[-1] for word in taken} - makes, makes


@pytest.mark.parametrize("readme", READMES)
def test_files_of_commands_exist_or_are_made_or_are_marked_as_placeholders(readme):
    made = {"tilt"} if "examples tilt --output tilt" in (ROOT / readme).read_text() else set()
    for before, lines in blocks(readme):
        whole = " ".join(lines)
        elsewhere = re.search(r"(n't|not) in this repository", before + whole) is not None
        for line in lines:
            if not COMMAND.match(line):
                continue
            takes, makes = arguments_of(line)
            made |= makes
            if elsewhere:
                continue
            for name in takes:
                if re.fullmatch(r"[A-Z_]+[/.]?[\w.]*", name):
                    assert "Names in capitals stand for your own" in whole, line
                else:
                    here = (ROOT / name).exists() or name.split("/")[0] in made
                    assert here, f"{readme}: {name}: neither there nor made before: {line}"
            if re.search(r" [A-Z]{3,}( |$)", line.partition(" #")[0]):
                assert "Names in capitals stand for your own" in whole, line


@pytest.mark.parametrize("readme", READMES)
def test_blocks_of_commands_say_which_nodes_they_need(readme):
    for _, lines in blocks(readme):
        whole = " ".join(lines)
        starts_them = "simulation.launch.py" in whole or " sim_driver_node" in lines[0]
        said = re.search(r"# nodes: .*\b(none|\w+_node|driver|those)\b", whole)
        assert starts_them or said or "ros2 " not in whole, f"{readme}: {lines[0]}"


PAGES = sorted({*READMES, *(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md"))})


# All but sketches, of which names are elsewhere.
PYTHON = [
    (page, code)
    for page in PAGES
    for code in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    if "import" in code
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "code"), PYTHON, ids=[page for page, _ in PYTHON])
def test_python_of_pages_runs(page, code, tmp_path):
    (tmp_path / "example.py").write_text(code)
    command = [sys.executable, str(tmp_path / "example.py")]
    ended = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert ended.returncode == 0, f"{page}: {ended.stderr}"


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page):
    targets = re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", (ROOT / page).read_text())
    assert [one for one in targets if not (ROOT / page).parent.joinpath(one).exists()] == []
