"""What the command line of the page refuses, and where it serves."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from ports import free_port

from bipedtrack import play
from bipedtrack.messages import Refusal

pytest.importorskip("viser")


def refused(*arguments: str, **environment: str) -> str:
    command = [sys.executable, "-m", "bipedtrack.play", *arguments]
    place = Path(play.__file__).parent.parent
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env={**os.environ, **environment}, cwd=place)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    return done.stderr


def test_a_missing_policy_is_refused_in_one_line() -> None:
    assert "nowhere.npz" in refused("nowhere.npz")


def test_a_port_in_use_is_refused_in_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"127.0.0.1:{port}: cannot listen there" in refused("--port", str(port))


def test_it_serves_until_interrupted_and_warns_where_others_may_come_in() -> None:
    command = [sys.executable, "-m", "bipedtrack.play", "--host", "0.0.0.0", "--port", str(free_port())]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, cwd=Path(play.__file__).parent.parent, **pipes) as running:  # type: ignore[call-overload]
        for line in running.stdout:
            if "http://0.0.0.0" in line and "Ctrl-C" in line:
                break
        running.send_signal(signal.SIGINT)
        try:
            assert running.wait(timeout=60) == 0
        finally:
            running.kill()
        assert "whoever reaches this machine" in running.stderr.read()


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [
        ("127.0.0.1", 0, "1 to 65535"),
        ("no such host", 8080, "wanted an address"),
        ("192.0.2.1", 8080, "cannot listen"),
    ],
)
def test_an_address_that_cannot_be(host: str, port: int, words: str) -> None:
    with pytest.raises(Refusal, match=words):
        play.require_free(host, port)


def test_whether_others_may_come_in() -> None:
    assert play.require_free("127.0.0.2", free_port()) is True
    assert play.require_free("0.0.0.0", free_port()) is False


def test_without_viser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["play"])
    monkeypatch.setattr(play.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as left:
        play.main()
    assert left.value.code == 2
    assert ".[play]" in capsys.readouterr().err


def test_the_shipped_policy_comes_first_and_a_given_one_before_it(tmp_path: Path) -> None:
    assert next(iter(play.choice(None))) == "best"
    given = tmp_path / "mine.npz"
    assert list(play.choice(given))[:2] == ["mine", "best"]
    assert list(play.choice(tmp_path / "best.npz"))[0] == str(tmp_path / "best.npz")
