# SPDX-License-Identifier: Apache-2.0
"""Archives of many small bags on a store like S3, on two workers of which one is killed.

    python -m galen_validation.archive 500 5000

For each number of bags: they are put on a server of moto on this machine, two Dask workers evaluate
them, one worker is killed after a quarter, and the results are compared with those of the same bags
evaluated here. Then the command runs again, and has nothing to do. Memory is the largest resident
set, processor time that of the command, the scheduler and each worker; the time includes the
command's start.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import psutil
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_gravcomp.evaluate.bag import BagJob
from galen_gravcomp.evaluate.bag_report import to_row
from galen_model.arm.galen import SENSOR
from galen_model.files.calibration_file import CalibrationFile, write_calibration
from pyarrow import parquet

from galen_validation.nominal import bench_tool

_START_NS = 1_767_225_600_000_000_000
_KINDS = 20
_POSES, _HOLD, _RATE_HZ = 6, 120, 100.0
_DEATH_AT = 0.25
_LOOK_S = 0.2
_WAIT_S = 1800.0


def write_bag(path: Path, tool: CalibrationFile, seed: int) -> None:
    """Write 7.2 s of still poses, some with a load that is not the file's.

    Args:
        path: Bag to write.
        tool: Calibration that predicts the wrench.
        seed: Of poses and noise; bags of every fourth seed have a load 10 % larger.

    """
    rng = np.random.default_rng(seed)
    angles = np.repeat(rng.uniform(-0.9, 0.9, (_POSES, 2)), _HOLD, axis=0)
    wrench = tool.predict(angles) * (1.0 + 0.1 * (seed % 4 == 0))
    wrench += rng.normal(size=wrench.shape) * SENSOR.noise_std
    states, forces = joint_state_bytes(tool.arm.joint_names), wrench_bytes(tool.sensor_frame)
    with BagWriter(path) as bag:
        joints = bag.add_topic("joint_states", "sensor_msgs/msg/JointState")
        wrenches = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        for row in range(len(angles)):
            stamp = _START_NS + round(row * 1e9 / _RATE_HZ)
            position = [0.0, 0.0, 0.408, *angles[row].tolist()]
            bag.write(joints, stamp, states.fill(stamp, position, [0.0] * 5))
            bag.write(wrenches, stamp + 1000, forces.fill(stamp, wrench[row].tolist()))


@contextlib.contextmanager
def running(folder: Path) -> Iterator[tuple[list[subprocess.Popen[bytes]], Path]]:
    """Run a server, a scheduler and two workers, and end them at the exit.

    The environment gets the server's address for clients of S3.

    Args:
        folder: Existing folder for the log, the port, the scheduler's file and the workers' data.

    Yields:
        Processes of the scheduler and both workers, and the scheduler's file.

    """
    server = (
        "import logging, os, time; logging.disable(); from moto.server import ThreadedMotoServer;"
        "s = ThreadedMotoServer('127.0.0.1', 0, verbose=False); s.start();"
        f"p = {str(folder / 'port')!r}; open(p + '.new', 'w').write(str(s.get_host_and_port()[1]));"
        "os.rename(p + '.new', p); time.sleep(1e6)"
    )
    address = folder / "scheduler.json"
    own = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port"]
    scheduler = [*own, "0", "--no-dashboard", "--scheduler-file", str(address)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(address)]
    worker += ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
    worker += ["--local-directory", str(folder)]
    started: list[subprocess.Popen[bytes]] = []

    def start(command: list[str], ready: Path | None = None) -> None:
        with (folder / "log").open("ab") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=log))
        while ready is not None and not ready.exists():
            time.sleep(_LOOK_S)

    try:
        start([sys.executable, "-c", server], folder / "port")
        port = (folder / "port").read_text()
        os.environ |= {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "bench",
            "AWS_SECRET_ACCESS_KEY": "bench",
            "AWS_DEFAULT_REGION": "us-east-1",
            "OMP_NUM_THREADS": "1",
        }
        start(scheduler, address)
        start(worker)
        start(worker)
        yield started[1:], address
    finally:
        for process in started:
            process.kill()
            process.wait()


def fill(store: Any, bags: Sequence[Path], count: int) -> None:
    """Put the bags on the store again and again, as `archive/bags/run_NUMBER`.

    Args:
        store: Filesystem of fsspec.
        bags: Local bags, taken in turn.
        count: Number of bags on the store.

    """
    contents = [{file.name: file.read_bytes() for file in bag.iterdir()} for bag in bags]
    for first in range(0, count, 250):
        store.pipe(
            {
                f"archive/bags/run_{number:06d}/{name}": content
                for number in range(first, min(first + 250, count))
                for name, content in contents[number % len(contents)].items()
            }
        )


def evaluate(
    arguments: list[str],
    cluster: Sequence[subprocess.Popen[bytes]],
    victim: subprocess.Popen[bytes] | None,
    store: Any,
    death_at: float,
) -> dict[str, Any]:
    """Run the command, and kill a worker when so many results are there.

    Args:
        arguments: The command's.
        cluster: Scheduler and workers.
        victim: The worker that is killed; None for none.
        store: Filesystem where the results are.
        death_at: Number of results at which the worker is killed.

    Returns:
        Counts and verdicts of the command's summary; wall time, s; processor time, s, and largest
        resident set, MB, of the command and each process of the cluster; whether a worker was
        killed.

    Raises:
        TimeoutError: The command takes longer than half an hour.

    """
    started_s = time.monotonic()
    command = [sys.executable, "-m", "galen_gravcomp.evaluate.command", *arguments, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    seen = [psutil.Process(one.pid) for one in (process, *cluster) if one.poll() is None]
    peak, cpu_s = [0] * len(seen), [0.0] * len(seen)
    before_s = [sum(one.cpu_times()[:2]) for one in seen]
    looked_s = 0.0
    while process.poll() is None:
        for number, one in enumerate(seen):
            with contextlib.suppress(psutil.Error):
                peak[number] = max(peak[number], one.memory_info().rss)
                spent_s = sum(one.cpu_times()[:2]) - before_s[number]
                cpu_s[number] = max(cpu_s[number], spent_s)  # 0 of one that is gone
        if victim is not None and victim.poll() is None and time.monotonic() - looked_s > 1.0:
            looked_s = time.monotonic()
            with contextlib.suppress(FileNotFoundError):
                if len(store.ls("archive/results/recordings", detail=False)) >= death_at:
                    victim.kill()
        time.sleep(_LOOK_S)
        if time.monotonic() - started_s > _WAIT_S:
            process.kill()
            raise TimeoutError("the command does not end")
    assert process.stdout is not None
    summary = json.loads(process.stdout.read())
    return {
        **{name: summary[name] for name in ("recordings", "done", "skipped", "failed", "verdicts")},
        "seconds": round(time.monotonic() - started_s, 1),
        "command_scheduler_worker_cpu_s": [round(one, 1) for one in cpu_s],
        "command_scheduler_worker_mb": [round(one / 1e6) for one in peak],
        "worker_killed": victim is not None and victim.poll() is not None,
    }


def measure(count: int, folder: Path) -> list[dict[str, Any]]:
    """Measure one archive, with a worker killed and again with nothing to do.

    Args:
        count: Number of bags.
        folder: Existing folder for bags, calibration and the cluster's files.

    Returns:
        What `evaluate` returns of the first and of the second run.

    Raises:
        AssertionError: A result is missing, there twice, or other than that of the same bag here.
        TimeoutError: A run takes longer than half an hour.

    """
    tool = folder / "tool.json"
    write_calibration(tool, bench_tool())
    bags = [folder / f"bag_{seed}" for seed in range(_KINDS)]
    for seed, bag in enumerate(bags):
        write_bag(bag, bench_tool(), seed)
    expected = [to_row(BagJob(tool=tool)(bag)) for bag in bags]
    with running(folder) as (cluster, address):
        store = fsspec.filesystem("s3", use_listings_cache=False, skip_instance_cache=True)
        store.mkdir("archive")
        fill(store, bags, count)
        arguments = ["s3://archive/bags", "--tool", str(tool), "--results", "s3://archive/results"]
        arguments += ["--scheduler", str(address)]
        found = [evaluate(arguments, cluster, cluster[-1], store, _DEATH_AT * count)]
        with store.open("archive/results/table.parquet") as stream:
            rows = parquet.read_table(stream).to_pylist()
        kept = store.ls("archive/results/recordings", detail=False)
        found.append(evaluate(arguments, cluster, None, store, 0.0))
    names = [f"s3://archive/bags/run_{number:06d}" for number in range(count)]
    if [row["recording"] for row in rows] != names or len(kept) != count:
        raise AssertionError(f"{len(rows)} rows and {len(kept)} results of {count} bags")
    for number, row in enumerate(rows):
        right = expected[number % _KINDS]
        if row["error"] or any(right[name] != row[name] for name in right if name in row):
            raise AssertionError(f"{row['recording']}: {row['error'] or 'another result'}")
    return found


def main() -> int:
    """Measure and print, as JSON; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("counts", nargs="+", type=int, help="numbers of bags")
    for count in parser.parse_args().counts:
        with tempfile.TemporaryDirectory(prefix="bench_archive_") as folder:
            for found in measure(count, Path(folder)):
                print(json.dumps(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
