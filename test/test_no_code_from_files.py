# SPDX-License-Identifier: Apache-2.0
"""Nothing that is read is ever run; of the sources ruff's rules S... (pyproject.toml) say so."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from fuzz.readers import READERS, check


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
