"""Fuzz a reader with atheris: made-up bytes, guided by which lines of the suite they reach.

    source scripts/env.sh && pip install atheris
    python test/fuzz/run.py --target tool_file --seconds 300

What a reader promises is in readers.py. The first broken promise ends the run; the bytes that did
it are written to FOLDER/crash-..., and `--try FILE` tries them again.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
PACKAGES = [f"galen_{name}" for name in ("model", "ros", "bags", "deflection", "gravcomp")]
PACKAGES += ["galen_diagnosis"]
TARGETS = (
    "tool_file", "model_json", "model_packed", "comparison", "table", "convert", "motion", "answer",
    "settings", "mcap", "mcap_zstd", "db3", "metadata", "messages",
)  # fmt: skip


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="exit codes: 0 nothing found, 1 something found or no atheris, 2 usage",
    )
    parser.add_argument("--target", choices=TARGETS, required=True, help="what to fuzz")
    parser.add_argument("--seconds", type=int, default=60, help="for how long (default: 60)")
    parser.add_argument("--seed", type=int, default=1, help="of the made-up bytes (default: 1)")
    parser.add_argument("--memory-mb", type=int, default=2048, help="most memory (default: 2048)")
    parser.add_argument(
        "--folder", type=Path, help="keeps what was found, to go on from (default: a temporary one)"
    )
    parser.add_argument("--try", dest="tried", type=Path, metavar="FILE", help="only this input")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def fuzz(given: argparse.Namespace, folder: Path) -> None:
    """In a process of its own, since libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=PACKAGES):
        from fuzz.readers import READERS, check
    reader = READERS[given.target]
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(reader.seeds()):
        (corpus / f"seed_{number}").write_bytes(seed)
    with tempfile.TemporaryDirectory() as work:
        atheris.Setup(
            [
                sys.argv[0], f"-max_total_time={given.seconds}", f"-seed={given.seed}",
                f"-rss_limit_mb={given.memory_mb}", "-timeout=20", "-print_final_stats=1",
                "-max_len=20000", "-len_control=0", f"-artifact_prefix={folder}/", str(corpus),
            ],
            lambda data: check(reader, data, Path(work)) and None,
        )  # fmt: skip
        atheris.Fuzz()


def summary(target: str, log: str, code: int, seconds: float) -> str:
    """One line of libFuzzer's report: how many were tried, and how much new they reached."""
    reached = [int(number) for number in re.findall(r"cov: (\d+)", log)]
    tried = re.search(r"stat::number_of_executed_units:\s+(\d+)", log)
    memory = re.search(r"stat::peak_rss_mb:\s+(\d+)", log)
    count = tried.group(1) if tried else (re.findall(r"^#(\d+)", log, re.MULTILINE) or ["0"])[-1]
    first, last = (reached[0], reached[-1]) if reached else (0, 0)
    return (
        f"{target}: {count} inputs in {seconds:.0f} s, reached {last} edges ({first} with the"
        f" seeds), peak {memory.group(1) if memory else '?'} MB,"
        f" {'nothing found' if code == 0 else 'FOUND SOMETHING'}"
    )


def main() -> int:
    """Run it."""
    given = options()
    if given.tried is not None:
        from fuzz.readers import READERS, check

        with tempfile.TemporaryDirectory() as work:
            read = check(READERS[given.target], given.tried.read_bytes(), Path(work))
        print("read" if read else "rejected")
        return 0
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("run.py: atheris is not installed: pip install atheris (Linux)", file=sys.stderr)
        return 1
    if given.inside:
        fuzz(given, given.folder)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        started_s = time.monotonic()
        done = subprocess.run(
            [
                sys.executable, __file__, *sys.argv[1:], "--inside", "--folder", str(folder),
            ],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
            check=False,
        )  # fmt: skip
        seconds = time.monotonic() - started_s
    if done.returncode:
        print("\n".join(done.stdout.splitlines()[-60:]), file=sys.stderr)
    print(summary(given.target, done.stdout, done.returncode, seconds))
    return 1 if done.returncode else 0


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.exit(main())
