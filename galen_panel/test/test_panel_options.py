# SPDX-License-Identifier: Apache-2.0
"""The command line, the way it ends, and the address that can't be had."""

import shutil
import signal
import socket
import ssl
import subprocess
import time
import urllib.request
from contextlib import closing

import pytest
from fake_suite import FakeSuite
from galen_model.errors import GalenError
from galen_panel.options import read_options
from galen_panel.server import serve
from panel_processes import PanelWorld, free_port

TOKEN = "a-token-of-24-characters"


@pytest.fixture
def world(tmp_path):
    with PanelWorld(tmp_path) as world:
        yield world


@pytest.fixture
def rejected():
    """Serve with a command line that must not get as far as a page, and give the reason."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.getsignal(number) for number in numbers]

    def reason(*arguments):
        with pytest.raises(GalenError) as error:
            serve(FakeSuite(), read_options(list(arguments), {}), lambda: None)
        return str(error.value)

    yield reason
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", "LocalHost", "::1", "[::1]", "127.8.9.1"]
)
def test_loopback_needs_no_token(host):
    options = read_options(["--host", host], {})
    assert options.token is None and "token" not in options.link


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "192.0.2.7", "robot.example", "127.0.0.1.example", "0", "localhost."],
)
def test_any_other_address_gets_a_token_that_is_new_each_time(host):
    tokens = {read_options(["--host", host], {}).token for _ in range(3)}
    assert len(tokens) == 3 and min(map(len, tokens)) >= 32


def test_a_token_of_the_environment_holds_everywhere():
    options = read_options([], {"GALEN_PANEL_TOKEN": TOKEN})
    assert options.token == TOKEN
    assert options.link == f"http://127.0.0.1:8080/?token={TOKEN}"


def test_links_are_such_as_a_browser_takes(tmp_path):
    assert read_options(["--host", "::1", "--port", "8090"], {}).link == "http://[::1]:8090/"
    anywhere = read_options(["--host", "0.0.0.0"], {})
    assert anywhere.link.startswith(f"http://{socket.gethostname()}:8080/?token=")
    pem = tmp_path / "any.pem"
    pem.touch()
    encrypted = read_options(["--certificate", str(pem), "--key", str(pem)], {})
    assert encrypted.link == "https://127.0.0.1:8080/"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--port", "0"], "0 is not in 1 ... 65535"),
        (["--port", "65536"], "65536 is not in"),
        (["--port", "eighty"], "eighty is not in"),
        (["--port", "-1"], "-1"),
        (["--host", ""], "empty"),
        (["--host", " "], "empty"),
        (["--bags-dir", "not/there"], "not/there: is no directory"),
        (["--bags-dir", "~nobody-of-this-name/bags"], "~nobody-of-this-name/bags"),
        (["--tools-dir", "~nobody-of-this-name/tools"], "~nobody-of-this-name/tools"),
        (["--certificate", "a.pem"], "go together"),
        (["--key", "a.pem"], "go together"),
        (["--certificate", "a.pem", "--key", "b.pem"], "a.pem: is no file"),
        (["--specification", "ur5e", "ur6"], "--specification ur6: is no file; presets: ati_"),
        (["--colour", "green"], "--colour"),
        (["here"], "here"),
    ],
)
def test_wrong_arguments_are_named(arguments, told, capsys):
    with pytest.raises(SystemExit) as ended:
        read_options(arguments, {})
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


def test_presets_and_files_are_what_is_healthy_at_first(tmp_path):
    file = tmp_path / "lab.json"
    file.touch()
    assert read_options([], {}).specification == ()
    given = ["--specification", "ur5e_calibrated", str(file)]
    assert read_options(given, {}).specification == ("ur5e_calibrated", str(file))


@pytest.mark.parametrize("token", ["short", "x" * 15, "with spaces " * 2, "ä" * 20, "a;b" * 9])
def test_a_token_that_is_easily_guessed_or_fits_no_link_is_rejected(token, capsys):
    with pytest.raises(SystemExit) as ended:
        read_options([], {"GALEN_PANEL_TOKEN": token})
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "GALEN_PANEL_TOKEN" in said and token not in said


def test_rejects_a_port_that_is_taken(rejected):
    with closing(socket.socket()) as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert rejected("--port", str(port)) == (
            f"can't listen at 127.0.0.1, port {port}: Address already in use;"
            " choose another port by --port, in a launch by panel_port:="
        )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--host", "192.0.2.7"), "can't listen at 192.0.2.7"),
        (("--output-dir", "{file}"), "choose another directory by --output-dir"),
        (("--output-dir", "{file}/below"), "choose another directory by --output-dir"),
        (("--certificate", "{file}", "--key", "{file}"), "can't use {file}"),
    ],
)
def test_what_can_not_be_served_is_rejected_in_a_line(rejected, tmp_path, arguments, words):
    file = tmp_path / "file"
    file.write_text("nothing of the kind\n")
    given = [word.format(file=file) for word in arguments]
    reason = rejected("--port", str(free_port()), *given)
    assert words.format(file=file) in reason and len(reason.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_code_0_also_with_a_connection_open(world, number):
    link = world.start_panel(fake=True)
    port = int(link.rstrip("/").rsplit(":")[-1])
    with closing(socket.create_connection(("127.0.0.1", port))) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert connection.recv(15) == b"HTTP/1.1 200 OK"
        assert world.end("panel", number, patience_s=3.0) == 0
    assert "Traceback" not in world.log("panel")


@pytest.mark.slow
def test_a_signal_that_is_repeated_ends_it_as_one_does(world):
    """As Ctrl-C does that a person presses twice, or that a launch hands on."""
    world.start_panel(fake=True)
    process = world.processes["panel"]
    # Until it is gone, lest one comes only after its end.
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    assert process.returncode == 0
    world.processes.pop("panel")
    assert "Traceback" not in world.log("panel")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl")
def test_it_serves_https(world, tmp_path):
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    request = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=panel"]
    subprocess.run(
        ["openssl", *request, "-addext", "subjectAltName=IP:127.0.0.1", "-out", certificate]
        + ["-keyout", key],
        check=True,
        capture_output=True,
    )
    link = world.start_panel("--certificate", certificate, "--key", key, fake=True)
    assert link.startswith("https://")
    trusting = ssl.create_default_context(cafile=str(certificate))
    with urllib.request.urlopen(link, context=trusting, timeout=20) as answer:
        assert answer.status == 200 and b"Galen" in answer.read()
