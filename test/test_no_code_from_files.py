"""Nothing that is read is ever run: no pickle, no unsafe YAML, no eval, no shell."""

from __future__ import annotations

import ast
import json
import os
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fuzz.readers import READERS, check

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path
    for place in ("galen_*/galen_*", "galen_*/launch", "scripts", "bags")
    for path in ROOT.glob(f"{place}/**/*.py")
)
MODULES = {
    "pickle", "_pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib",
    "jsonpickle", "imp", "code", "runpy",
}  # fmt: skip
BUILTINS = {"eval", "exec", "compile", "__import__"}
SAFE_LOADERS = {"SafeLoader", "BaseLoader", "CSafeLoader"}
# No module without one of these words holds anything of the lists; parsing takes its time.
WORDS = re.compile(
    rf"\b({'|'.join([*MODULES, *BUILTINS])})\b|system|popen|mktemp|extractall|shell|yaml|pickle"
    "|torch.load|load_state_dict_from_url"
)
# Where something on the lists is used all the same, and why that runs nothing from a file.
KNOWN = {
    ("galen_bags/galen_bags/many/run.py", "distributed.protocol.pickle"):
        "only dumps, to see whether a result can be sent between one's own workers",
}  # fmt: skip


def dotted(node: ast.AST) -> str:
    """As in "yaml.load"; what is no name is left out (ast.unparse takes ten times as long)."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def found(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of everything in a module that could run what it reads."""
    safe = set(SAFE_LOADERS) | {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any(dotted(base).split(".")[-1] in SAFE_LOADERS for base in node.bases)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            names = []
        yield from ((node.lineno, name) for name in names if MODULES & set(name.split(".")))
        if not isinstance(node, ast.Call):
            continue
        called = dotted(node.func)
        last = called.split(".")[-1]
        options = {keyword.arg: keyword.value for keyword in node.keywords}
        if isinstance(node.func, ast.Name) and called in BUILTINS:
            yield node.lineno, called
        if called in ("os.system", "os.popen", "tempfile.mktemp") or last == "extractall":
            yield node.lineno, called
        if "shell" in options and ast.unparse(options["shell"]) != "False":
            yield node.lineno, f"{called}(shell)"
        if called.startswith("yaml.") and last in (
            "load", "load_all", "full_load", "unsafe_load", "full_load_all", "unsafe_load_all",
            "parse", "compose", "scan",
        ):  # fmt: skip
            loader = ast.unparse(options["Loader"]).split(".")[-1] if "Loader" in options else ""
            if loader not in safe:
                yield node.lineno, f"{called}(Loader={loader})"
        if "allow_pickle" in options and ast.unparse(options["allow_pickle"]) != "False":
            yield node.lineno, f"{called}(allow_pickle)"
        if called in ("torch.load", "load_state_dict_from_url") and (
            "weights_only" not in options or ast.unparse(options["weights_only"]) != "True"
        ):
            yield node.lineno, called


def test_no_module_can_run_what_it_reads() -> None:
    assert len(SOURCES) > 200
    here = {
        (str(path.relative_to(ROOT)), name)
        for path in SOURCES
        if WORDS.search(text := path.read_text(encoding="utf-8"))
        for _, name in found(ast.parse(text))
    }
    assert here == set(KNOWN)


@pytest.mark.parametrize(
    "text",
    [
        "import pickle", "from pickle import loads", "from os import path; import dill.settings",
        "eval(x)", "exec(x)", "__import__(x)", "import os; os.system(x)",
        "subprocess.run(x, shell=True)", "subprocess.run(x, shell=y)", "yaml.load(x)",
        "yaml.load(x, Loader=yaml.Loader)", "yaml.full_load(x)", "np.load(x, allow_pickle=True)",
        "torch.load(x)", "torch.load(x, weights_only=False)", "z.extractall(x)",
    ],
)  # fmt: skip
def test_the_check_finds_it(text: str) -> None:
    assert WORDS.search(text) and list(found(ast.parse(text)))


@pytest.mark.parametrize(
    "text",
    [
        "yaml.load(x, Loader=yaml.SafeLoader)", "yaml.safe_load(x)", "np.load(x)", "re.compile(x)",
        "model.eval()", "torch.load(x, weights_only=True)", "subprocess.run(x, shell=False)",
        "class L(yaml.SafeLoader): pass\nyaml.load(x, Loader=L)",
    ],
)  # fmt: skip
def test_the_check_lets_the_rest_be(text: str) -> None:
    assert not list(found(ast.parse(text)))


class _Runs:
    def __init__(self, witness: Path) -> None:
        self.witness = witness

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.witness),)


@pytest.mark.parametrize("name", [name for name in READERS if name != "messages"])
def test_a_file_with_code_in_it_is_rejected_and_not_run(name: str, tmp_path: Path) -> None:
    witness = tmp_path / "was_run"
    folder = tmp_path / "files"
    folder.mkdir()
    pickled = pickle.dumps(_Runs(witness))
    array = folder / "array.npy"
    np.save(array, np.array([_Runs(witness)], dtype=object), allow_pickle=True)
    described = json.dumps({"__metadata__": {"galen_deflection": f"!!python {witness}"}}).encode()
    payloads = [
        pickled,
        array.read_bytes(),
        len(described).to_bytes(8, "little") + described + pickled,
        f"!!python/object/apply:os.mkdir ['{witness}']".encode(),
        f"__import__('os').mkdir('{witness}')".encode(),
    ]
    for payload in payloads:
        # A bag's metadata that can't be used is left aside: its files tell all.
        assert check(READERS[name], payload, folder) == (name == "metadata")
        assert not witness.exists()
    pickle.loads(pickled)
    assert witness.exists()  # it would have run
