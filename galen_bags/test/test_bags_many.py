# SPDX-License-Identifier: Apache-2.0
import argparse
import contextlib
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import psutil
import pytest
from bags_wait import wait_for
from galen_bags.formats.errors import BagError
from galen_bags.many import run_many
from galen_common.command import add_workers
from galen_model.errors import GalenError

WAIT_S = 30.0
NOTHING_SAID = 0.3  # s without an answer are enough to see that there is none

# What is done with a "bag" here goes by its name.


def work(bag, scale=1):
    if bag.name.startswith("good"):
        return scale * int(bag.suffix[1:])
    if bag.name == "rejected":
        raise BagError(f"{bag}: its stamps\njump")
    if bag.name == "bug":
        raise ValueError("not\nnow")
    if bag.name == "exits":
        sys.exit("enough")
    if bag.name == "unsendable":
        return (i for i in range(3))
    if bag.name == "dies":
        os._exit(3)
    raise AssertionError(bag)


def surroundings(bag):
    """What a worker process has around it."""
    listening = [
        connection.laddr.ip
        for connection in psutil.Process().net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    return os.getpid(), os.environ["OMP_NUM_THREADS"], listening, str(Path.cwd())


def make(folder, *names):
    for name in names:
        (folder / name).touch()
    return [folder / name for name in names]


@contextlib.contextmanager
def cluster_of_threads(workers, folder):
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"temporary-directory": str(folder)}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=False,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
        ) as made,
    ):
        yield made


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with cluster_of_threads(3, tmp_path_factory.mktemp("dask")) as made:
        yield made


@pytest.fixture(params=["here", "cluster"])
def where(request):
    if request.param == "here":
        return {"workers": 1}
    return {"scheduler": request.getfixturevalue("cluster").scheduler_address}


def test_a_bag_that_fails_does_not_stop_the_others(tmp_path, where):
    bags = make(tmp_path, "good.1", "rejected", "good.2", "bug", "exits", "good.3")
    outcomes = run_many(functools.partial(work, scale=10), bags, **where)
    assert [outcome.bag for outcome in outcomes] == bags
    assert [outcome.result for outcome in outcomes] == [10, None, 20, None, None, 30]
    errors = [outcome.error for outcome in outcomes]
    assert [error is None for error in errors] == [True, False, True, False, False, True]
    assert errors[1] == f"{bags[1]}: its stamps\\njump"
    assert errors[3].startswith(f"{bags[3]}: ValueError: not now (test_bags_many.py, line ")
    assert errors[4].startswith(f"{bags[4]}: SystemExit: enough (")
    assert all(outcome.seconds >= 0.0 for outcome in outcomes)


def test_a_result_that_cannot_be_sent_is_that_bag_s_error(tmp_path, cluster):
    bags = make(tmp_path, "unsendable", "good.1")
    bad, good = run_many(work, bags, scheduler=cluster.scheduler_address)
    assert good.result == 1
    assert "result can't be sent from the worker: TypeError: cannot pickle" in bad.error


def test_a_bag_that_workers_do_not_see_says_what_they_must_see(tmp_path, cluster):
    (outcome,) = run_many(work, [tmp_path / "good.1"], scheduler=cluster.scheduler_address)
    assert outcome.error.startswith(f"{tmp_path / 'good.1'}: is not there on ")
    assert outcome.error.endswith("its workers must see the same paths")


def test_a_scheduler_file_names_the_scheduler(tmp_path, cluster):
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": cluster.scheduler_address}))
    (outcome,) = run_many(work, make(tmp_path, "good.4"), scheduler=str(file))
    assert outcome.result == 4


@contextlib.contextmanager
def server(answer):
    """Address of something that is no scheduler; without an answer it is silent."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listening.accept()
                    with connection:
                        connection.sendall(answer)

        if answer:
            threading.Thread(target=serve, daemon=True).start()
        yield f"tcp://127.0.0.1:{listening.getsockname()[1]}"


@pytest.mark.parametrize("answer", [b"", b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n" * 4])
def test_what_is_no_scheduler_is_named_and_not_waited_for(tmp_path, answer):
    with (
        server(answer) as address,
        pytest.raises(GalenError, match=f"^{address}: (no scheduler answers|can't be asked)"),
    ):
        run_many(work, make(tmp_path, "good.1"), scheduler=address, timeout_s=NOTHING_SAID)


def test_a_scheduler_without_workers_is_not_waited_for(tmp_path):
    with (
        cluster_of_threads(0, tmp_path) as empty,
        pytest.raises(GalenError, match="the scheduler has no workers"),
    ):
        run_many(work, make(tmp_path, "good.1"), scheduler=empty.scheduler_address)


def test_wrong_calls_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="absolute"):
        run_many(work, [Path("good.1")], scheduler="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="at least 1"):
        run_many(work, [tmp_path], workers=0)
    with pytest.raises(ValueError, match="its own"):
        run_many(work, [tmp_path], workers=2, scheduler="tcp://127.0.0.1:1")


def test_one_bag_is_worked_on_here_without_dask(tmp_path):
    code = (
        "import os, pathlib, sys; from galen_bags.many import run_many;"
        "(outcome,) = run_many(str, [pathlib.Path('bag')]);"
        "assert outcome.result == 'bag';"
        "assert not {'dask', 'distributed'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_options_of_commands(capsys):
    parser = argparse.ArgumentParser()
    add_workers(parser.add_argument_group("bags"))
    assert vars(parser.parse_args([])) == {"scheduler": None, "workers": None}
    assert parser.parse_args(["--workers", "3"]).workers == 3
    assert parser.parse_args(["--scheduler", "tcp://a:1"]).scheduler == "tcp://a:1"
    for wrong in (["--workers", "0"], ["--workers", "x"], ["--workers=2", "--scheduler=tcp://a:1"]):
        with pytest.raises(SystemExit) as raised:
            parser.parse_args(wrong)
        assert raised.value.code == 2
    assert "not allowed with" in capsys.readouterr().err


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.mark.slow
def test_a_bag_that_ends_its_process_does_not_take_others_along(tmp_path, temporary, capfd):
    names = ["dies", "good.1", "rejected", "good.2"]
    outcomes = run_many(work, [tmp_path / name for name in names], workers=2)
    assert [outcome.result for outcome in outcomes] == [None, 1, None, 2]
    died = f"{tmp_path / 'dies'}: the process that worked on it died: it crashed, was killed"
    assert outcomes[0].error.startswith(died)
    assert not list(temporary.iterdir())
    assert not _workers()
    assert capfd.readouterr() == ("", "")


def _workers():
    return [
        child
        for child in psutil.Process().children(recursive=True)
        if "spawn_main" in " ".join(child.cmdline())
    ]


@pytest.mark.slow
def test_processes_are_reachable_from_here_only_and_leave_nothing(tmp_path, temporary):
    bags = make(tmp_path, "a", "b", "c")
    results = [outcome.result for outcome in run_many(surroundings, bags, workers=2)]
    assert os.getpid() not in {pid for pid, *_ in results}
    for pid, threads, listening, folder in results:
        assert threads == os.environ.get("OMP_NUM_THREADS", "1")
        assert listening and set(listening) == {"127.0.0.1"}
        assert folder == str(Path.cwd())
        assert not psutil.pid_exists(pid)
    assert not list(temporary.iterdir())


SCRIPT = """
import sys, time
from pathlib import Path
from galen_bags.many import run_many
from galen_common.command import add_workers

def work(bag):
    bag.touch()
    time.sleep(600)

def main():
    try:
        run_many(work, [Path(name) for name in sys.argv[1:]], workers=2)
    except KeyboardInterrupt:
        sys.exit(130)

if __name__ == "__main__":
    main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["terminal", "kill"])
def test_an_interrupt_leaves_no_process(tmp_path, end):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    bags = [tmp_path / name for name in "abc"]
    process = subprocess.Popen(
        [sys.executable, script, *bags],
        start_new_session=True,
        # A shell that runs the tests in the background has them ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    try:
        for bag in bags[:2]:
            wait_for(bag.exists, str(bag))
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        if end == "terminal":  # which sends it to all processes
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.kill()
        output = process.communicate(timeout=WAIT_S)
        _, alive = psutil.wait_procs(children, timeout=WAIT_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert not alive
    if end == "terminal":
        assert process.returncode == 130
        assert output == (b"", b"")
        assert not list(tmp_path.glob("galen_bags_*"))


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.partition("if __name__")[0] + "main()\n")
    process = subprocess.run(
        [sys.executable, script, tmp_path / "a", tmp_path / "b"],
        capture_output=True,
        text=True,
        timeout=WAIT_S * 2,
        check=False,
    )
    assert process.returncode == 1
    last = process.stderr.strip().splitlines()[-1]
    assert "GalenError: " in last
    assert 'below `if __name__ == "__main__":`' in last
