# SPDX-License-Identifier: Apache-2.0
"""Fuzz a reader with atheris: made-up bytes, guided by which lines of the suite they reach.

    source scripts/env.sh && pip install atheris
    python test/fuzz/run.py --target tool_file --seconds 300

What a reader promises is in readers.py. The first broken promise ends the run; the bytes that did
it are written to FOLDER/crash-...
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
PACKAGES = ("model", "ros", "bags", "deflection", "gravcomp", "diagnosis")
with atheris.instrument_imports(include=[f"galen_{name}" for name in PACKAGES]):
    from fuzz.readers import READERS, check


def main() -> None:
    """Run until something is found or the time is over; libFuzzer ends the process."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--target", choices=READERS, required=True, help="what to fuzz")
    parser.add_argument("--seconds", type=int, default=60, help="for how long (default: 60)")
    parser.add_argument("--seed", type=int, default=1, help="of the made-up bytes (default: 1)")
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.mkdtemp()), help="keeps what was found"
    )
    given = parser.parse_args()
    reader = READERS[given.target]
    corpus = given.folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(reader.seeds()):
        (corpus / f"seed_{number}").write_bytes(seed)
    work = Path(tempfile.mkdtemp())
    atheris.Setup(
        [
            sys.argv[0], f"-max_total_time={given.seconds}", f"-seed={given.seed}",
            "-rss_limit_mb=2048", "-timeout=20", "-print_final_stats=1", "-max_len=20000",
            "-len_control=0", f"-artifact_prefix={given.folder}/", str(corpus),
        ],
        lambda data: check(reader, data, work) and None,
    )  # fmt: skip
    atheris.Fuzz()


if __name__ == "__main__":
    main()
