# SPDX-License-Identifier: Apache-2.0
"""Archives on a store like S3 on this machine, and results that are kept one by one."""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
from bags_wait import wait_for
from galen_bags.archive import _COPY, TABLE, Archive, _above, find_recordings, local_copy, place
from galen_bags.many import ArchivedRecording, name_depth, name_of
from galen_model.errors import GalenError

HERE = Path(__file__).parent
WAIT_S = 60.0
COLUMNS = {"verdict": "string", "size": "int64"}


def size(bag):
    """Stands for an evaluation: the sum of a bag's bytes; broken ones fail."""
    with local_copy(bag, "tool.json") as path:
        files = list(path.iterdir()) if path.is_dir() else [path]
        total = sum(file.stat().st_size for file in files)
        if total == 13:
            raise GalenError(f"{path}: unlucky")
        beside = (path.parent / "tool.json").exists()
    return {"verdict": "with tool" if beside else "bare", "size": total}


def slow_size(bag):
    time.sleep(0.3)
    return size(bag)


def to_row(content):
    return {name: content[name] for name in COLUMNS}


@pytest.fixture(scope="module")
def bucket():
    """URL of an empty bucket."""
    server = pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    fsspec = pytest.importorskip("fsspec")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    _, port = running.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "tester")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        store = fsspec.filesystem("s3", use_listings_cache=False)
        store.mkdir("lab")
        yield "s3://lab", store
    running.stop()


@pytest.fixture
def archive(bucket, request):
    """URL of ten bags, of which one is broken, in a folder of its own."""
    url, store = bucket
    root = f"lab/{request.node.name}"
    for number in range(4):
        store.pipe_file(f"{root}/a/run_{number}/metadata.yaml", b"x" * number)
        store.pipe_file(f"{root}/a/run_{number}/run_{number}_0.mcap", b"y" * 20)
        store.pipe_file(f"{root}/b/{number}.mcap", b"z" * (10 + number))
    store.pipe_file(f"{root}/cut/cut_0.mcap", b"c")
    store.pipe_file(f"{root}/c.db3.zstd", b"d")
    store.pipe_file(f"{root}/b/tool.json", b"{}")
    store.pipe_file(f"{root}/b/.hidden.mcap", b"no")
    store.pipe_file(f"{root}/a/run_0/more/inside.mcap", b"no")
    for folder in ("", "a/", "a/run_0/"):  # as the console's "Create folder"
        store.call_s3("put_object", Bucket="lab", Key=f"{root}/{folder}"[4:], Body=b"")
    return f"{url}/{request.node.name}", store


def bags_of(url):
    return find_recordings([url], files=["tool.json"])


def rows_of(results):
    parquet = pytest.importorskip("pyarrow.parquet")
    with local_copy(results / TABLE if isinstance(results, Path) else f"{results}/{TABLE}") as path:
        return parquet.read_table(path).to_pylist()


def test_bags_on_a_store_are_found_by_the_rules_of_those_on_a_disk(archive, tmp_path):
    url, store = archive
    files = [key for key in store.find(url) if not key.endswith("/")]
    store.get(files, [str(tmp_path / "copy" / key.split("/", 2)[2]) for key in files])
    here = [str(bag)[len(str(tmp_path / "copy")) :] for bag in bags_of(tmp_path / "copy")]
    there = [str(bag)[len(url) :] for bag in bags_of(url)]
    assert there == here and len(there) == 10
    assert bags_of(f"{url}/b/1.mcap")[0].place == f"{url}/b/1.mcap"
    assert bags_of(f"{url}/a/run_1")[0].place == f"{url}/a/run_1"
    with pytest.raises(GalenError, match="nothing: is not there"):
        bags_of(f"{url}/nothing")


def test_the_diagnosis_recordings_are_directories_with_its_bags(archive):
    url, store = archive
    for name in ("sweep/metadata.yaml", "push/p.mcap", "tool.json", "truth.json", "sweep/x/y"):
        store.pipe_file(f"{url}/one/{name}", b"1")
    bags, files = ("sweep", "push"), ("tool.json",)
    (found,) = find_recordings([url], bags, files)
    assert found.place == f"{url}/one"
    with local_copy(found.place, folders=bags, files=files) as path:
        copied = sorted(str(file.relative_to(path)) for file in path.rglob("*") if file.is_file())
    assert copied == ["push/p.mcap", "sweep/metadata.yaml", "tool.json"]
    assert not path.exists()
    with pytest.raises(GalenError, match="no recording with sweep"):
        find_recordings([f"{url}/one/sweep"], bags, files)


def test_a_file_beside_is_looked_for_within_the_bucket_and_what_may_be_read(bucket, monkeypatch):
    _, store = bucket
    store.mkdir("root")
    for name in ("run.mcap", "tool.json", "deep/run.mcap"):
        store.pipe_file(f"root/{name}", b"1")
    assert size("s3://root/run.mcap")["verdict"] == "with tool"
    get_file = type(store).get_file

    def limited(self, key, path):
        if key == "root/tool.json":
            raise PermissionError("Forbidden")
        get_file(self, key, path)

    monkeypatch.setattr(type(store), "get_file", limited)
    assert size("s3://root/deep/run.mcap")["verdict"] == "bare"


def test_directories_above_end_with_the_bucket_or_host():
    assert _above("lab") == []
    assert _above("https://lab.org/run.mcap") == ["https://lab.org"]
    assert _above("lab/a/b/c") == ["lab/a/b", "lab/a"]


def test_local_recordings_that_can_t_be_read_or_named_do_not_stop_the_others(tmp_path, monkeypatch):
    (tmp_path / os.fsdecode(b"caf\xe9.mcap")).write_bytes(b"123")
    (tmp_path / "ok.mcap").write_bytes(b"1234")
    done = Archive(size, tmp_path / "out", {}).run(bags_of(tmp_path), COLUMNS, to_row, workers=1)
    assert (done["done"], done["failed"]) == (2, 0)
    assert sorted(row["size"] for row in rows_of(tmp_path / "out")) == [3, 4]

    def closed(path):
        raise PermissionError(13, "Permission denied")

    for name in ("a/sweep", ".old/sweep"):
        (tmp_path / "lab" / name).mkdir(parents=True)
    monkeypatch.setattr(Path, "iterdir", closed)
    found = find_recordings([tmp_path / "lab" / "a", tmp_path / "lab"], ["sweep"])
    assert [one.place for one in found] == [tmp_path / "lab" / "a"]


def test_every_recording_gets_one_row_and_a_second_run_skips_it(archive, capsys):
    """With results on the store; in a folder they are those of the command that was killed."""
    url, store = archive
    results = f"{url}-results"
    kept = Archive(size, results, {"limit": 1})
    first = kept.run(bags_of(url), COLUMNS, to_row, workers=1)
    assert [first[name] for name in ("recordings", "done", "skipped", "failed")] == [10, 9, 0, 1]
    assert first["verdicts"] == {"bare": 6, "with tool": 3}
    rows = rows_of(results)
    assert [row["recording"] for row in rows] == [str(bag) for bag in bags_of(url)]
    (failed,) = [row for row in rows if row["error"]]
    assert failed["error"] == f"{url}/b/3.mcap: unlucky" and failed["verdict"] is None
    assert sum(row["size"] or 0 for row in rows) == 4 * 20 + 6 + 10 + 11 + 12 + 2
    # A broken one that was replaced is done, and so is what another setting asks for.
    store.pipe_file(f"{url}/b/3.mcap", b"z" * 14)
    second = kept.run(bags_of(url), COLUMNS, to_row, workers=1)
    assert [second[name] for name in ("done", "skipped", "failed")] == [1, 9, 0]
    assert "9 of 10 results are there" in capsys.readouterr().err
    other = Archive(size, results, {"limit": 2}).run(bags_of(url), COLUMNS, to_row, workers=1)
    assert other["done"] == 10


def test_a_changed_tool_beside_the_bag_asks_for_a_new_result(archive):
    url, store = archive
    before = {str(bag): bag.version for bag in bags_of(url)}
    assert bags_of(f"{url}/b/2.mcap")[0].version == before[f"{url}/b/2.mcap"]
    store.pipe_file(f"{url}/b/tool.json", b"{} ")
    after = {str(bag): bag.version for bag in bags_of(url)}
    changed = {bag[len(url) :] for bag in after if after[bag] != before[bag]}
    assert changed == {"/b/0.mcap", "/b/1.mcap", "/b/2.mcap", "/b/3.mcap"}


@pytest.mark.parametrize(
    ("verdict", "number"),
    [("[1]", "1"), ("null", "1"), ('"fits"', '"x"'), ('"fits"', 2**70), ("", "")],
)
def test_an_unreadable_result_is_a_row_that_names_it(tmp_path, verdict, number):
    for name in ("a", "b"):
        (tmp_path / f"{name}.mcap").write_bytes(b"1")
    kept = Archive(size, tmp_path / "out", {})
    kept.run(bags_of(tmp_path), COLUMNS, to_row, workers=1)
    broken = sorted((tmp_path / "out" / "recordings").iterdir())[0]
    broken.write_text(f'{{"verdict": {verdict}, "size": {number}}}')
    done = kept.run(bags_of(tmp_path), COLUMNS, to_row, workers=1)
    assert [done[name] for name in ("done", "skipped", "failed")] == [0, 1, 1]
    (row,) = [row for row in rows_of(tmp_path / "out") if row["error"]]
    assert broken.name in row["error"] and "remove it" in row["error"]


def test_a_result_that_another_command_has_kept_meanwhile_stays(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"1")
    kept, (bag,) = Archive(size, tmp_path / "out", {}), bags_of(tmp_path)
    kept(bag)
    kept(bag)
    assert len(list((tmp_path / "out" / "recordings").iterdir())) == 1


def test_a_result_that_is_not_seen_here_says_that_the_folder_must_be_shared(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"1")
    monkeypatch.setattr(Archive, "__call__", lambda self, recording: None)
    kept = Archive(size, tmp_path / "out", {})
    (error,) = kept.run(bags_of(tmp_path), COLUMNS, to_row, workers=1)["errors"]
    assert "a folder that all share" in error


def test_a_table_that_can_t_be_written_is_one_error(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"1")

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pytest.importorskip("pyarrow.parquet"), "ParquetWriter", full)
    with pytest.raises(GalenError, match=r"table\.parquet: can't be written: .*No space left"):
        Archive(size, tmp_path / "out", {}).run(bags_of(tmp_path), COLUMNS, to_row, workers=1)


def test_copies_of_killed_processes_are_removed(archive, tmp_path, monkeypatch):
    url, _ = archive
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for process in (ended.pid, os.getpid()):
        (tmp_path / f"{_COPY}{process}_x" / "above").mkdir(parents=True)
    with local_copy(f"{url}/a/run_0"):
        pass
    assert [copy.name for copy in tmp_path.iterdir()] == [f"{_COPY}{os.getpid()}_x"]


def test_a_name_that_leads_out_of_the_copy_is_rejected(monkeypatch):
    class Store:
        def find(self, root, maxdepth, detail):
            return {f"{root}/..": {"size": 1}, f"{root}/run.mcap": {"size": 1}}

        def get_file(self, key, path):
            raise AssertionError(key)

    monkeypatch.setattr("fsspec.core.url_to_fs", lambda url, **options: (Store(), "lab/run"))
    with pytest.raises(GalenError, match=r"'\.\.' can't be the name"), local_copy("s3://lab/run"):
        pass


def test_a_recording_that_the_disk_has_no_room_for_is_rejected(archive, tmp_path, monkeypatch):
    url, _ = archive
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("shutil.disk_usage", lambda path: argparse.Namespace(free=5))
    with pytest.raises(GalenError, match="free: set TMPDIR"), local_copy(f"{url}/a/run_0"):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "given",
    [
        "s3://key:secret@lab/a",
        "s3://key:se/cret@lab/a",
        "https://lab.org/a.mcap?sig=secret",
        "https://lab.org/a.mcap#sig=secret",
        "https://u:secret[w@lab.org/a",
        "https://u:12/secret@lab.org/a",
        "s3://",
        "memory://a",
        "file:///etc",
    ],
)
def test_urls_with_credentials_and_unknown_stores_are_rejected(given):
    with pytest.raises(argparse.ArgumentTypeError) as raised:
        place(given)
    assert "cret" not in str(raised.value)


@pytest.mark.parametrize(
    "given", ["s3://lab/10:30 a@b #1?.mcap", "https://lab.org:8443/a%40b.mcap", "gs://lab/"]
)
def test_urls_of_odd_names_are_taken(given):
    assert place(given) == given.rstrip("/")


def test_a_url_that_a_server_led_to_keeps_its_signature_to_itself(monkeypatch):
    def fails(url, **options):
        raise ValueError("403, url='https://other.org/x.mcap?X-Sig=secret'")

    monkeypatch.setattr("fsspec.core.url_to_fs", fails)
    with pytest.raises(GalenError, match=r"x\.mcap\?\.\.\.'") as raised:
        size("https://lab.org/x.mcap")
    assert "secret" not in str(raised.value)


def test_a_store_whose_package_lacks_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(GalenError, match="pip install gcsfs"), local_copy("gs://lab/a.mcap"):
        pass


def test_results_on_a_web_server_are_rejected_before_the_work():
    kept = Archive(size, "https://lab.org/results", {})
    with pytest.raises(GalenError, match="can't be written to"):
        kept.run([ArchivedRecording("s3://lab/a")], COLUMNS, to_row, workers=1)


def test_names_are_as_long_as_they_must_be_to_differ():
    places = ["s3://lab/a/run.mcap", "s3://lab/b/run.mcap", "s3://lab/b/x \n"]
    depth = name_depth(places)
    assert [name_of(one, depth) for one in places] == ["a_run", "b_run", "b_x__"]


SCRIPT = """
import sys
from test_bags_archive import COLUMNS, Archive, bags_of, slow_size, to_row
from pathlib import Path
if __name__ == "__main__":
    archive = Archive(slow_size, Path(sys.argv[2]), {})
    archive.run(bags_of(sys.argv[1]), COLUMNS, to_row, workers=1)
"""


def kept_in(results):
    folder = results / "recordings"
    return {file.name for file in folder.glob("*.json")} if folder.is_dir() else set()


@pytest.mark.parametrize(
    "end", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_a_command_that_was_killed_goes_on_where_it_was(archive, tmp_path, end):
    url, store = archive
    store.rm_file(f"{url}/b/3.mcap")
    script, results = tmp_path / "script.py", tmp_path / "out"
    script.write_text(SCRIPT)
    places = os.pathsep.join([str(HERE), *sys.path])
    command = [sys.executable, script, url, results]
    process = subprocess.Popen(
        command,
        env={**os.environ, "PYTHONPATH": places},
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        wait_for(lambda: len(kept_in(results)) >= 2 or process.poll() is not None)
    finally:
        process.send_signal(end)
        process.wait(WAIT_S)
    before = {name: (results / "recordings" / name).stat().st_mtime_ns for name in kept_in(results)}
    assert 2 <= len(before) < 9
    if end == signal.SIGINT:
        errors = [row["error"] for row in rows_of(results)]
        assert sum(error is not None for error in errors) == 9 - len(before)
    done = Archive(size, results, {}).run(bags_of(url), COLUMNS, to_row, workers=1)
    assert (done["skipped"], done["done"], done["failed"]) == (len(before), 9 - len(before), 0)
    for name, time_ns in before.items():
        assert (results / "recordings" / name).stat().st_mtime_ns == time_ns
    assert len(rows_of(results)) == 9
    assert not any(row["error"] for row in rows_of(results))
    assert json.loads(next(results.glob("settings-*.json")).read_text()) == {}


@pytest.fixture
def cluster(tmp_path):
    """A scheduler of its own with two workers: its file, its process, the workers'."""
    file, started = tmp_path / "scheduler.json", []
    log = (tmp_path / "log").open("w")

    def start(program, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments]
        command += ["--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard"]
        started.append(
            subprocess.Popen(
                command,
                env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])},
                stdout=log,
                stderr=log,
                cwd=tmp_path,
            )
        )

    start("scheduler", "--port", "0")
    wait_for(file.exists)
    for _ in range(2):
        start("worker", "--nthreads", "1", "--no-nanny")
    wait_for(lambda: (tmp_path / "log").read_text().count("Registered to") == 2)
    yield file, started
    for process in started:
        process.kill()
        process.wait()
    log.close()


def killed_after(process, results, count):
    """Kill a process when so many results are there; returns the thread that waits for it."""

    def wait():
        wait_for(lambda: len(kept_in(results)) >= count)
        process.kill()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


@pytest.mark.slow
def test_a_dead_worker_and_a_lost_scheduler_lose_nothing(archive, cluster, tmp_path):
    url, store = archive
    store.rm_file(f"{url}/b/3.mcap")
    file, (scheduler, worker, other) = cluster
    kept = Archive(slow_size, tmp_path / "out", {})
    death = killed_after(worker, kept.results, 2)
    done = kept.run(bags_of(url), COLUMNS, to_row, scheduler=str(file))
    death.join()
    assert (done["done"], done["failed"]) == (9, 0) and worker.wait() < 0
    rows = rows_of(kept.results)
    kept = Archive(slow_size, tmp_path / "again", {})
    death = killed_after(scheduler, kept.results, 2)
    done = kept.run(bags_of(url), COLUMNS, to_row, scheduler=str(file))
    death.join()
    assert 2 <= done["done"] < 9 and done["done"] + done["failed"] == 9
    assert all("was lost" in error and "run the command again" in error for error in done["errors"])
    other.kill()
    done = kept.run(bags_of(url), COLUMNS, to_row, workers=1)
    assert done["skipped"] >= 2 and done["failed"] == 0
    assert rows_of(kept.results) == rows and len(kept_in(kept.results)) == 9
