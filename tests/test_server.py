"""Who may speak with the page's server: viewers of its own page and programs, no other website."""

import asyncio
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
import websockets
from ports import free_port

pytest.importorskip("viser")
import viser  # noqa: E402

from bipedtrack.server import Server, foreign  # noqa: E402


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    found = Server("127.0.0.1", free_port(), local=True)
    yield found
    found.stop()


def connects(server: Server, host: str | None = None, **options: object) -> bool:
    """Whether a socket is opened and the page's first message arrives."""
    port = server.get_port()

    async def first() -> bool:
        url = f"ws://{host or '127.0.0.1'}:{port}"
        protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
        options["host"] = "127.0.0.1"  # where it connects to, whatever the URL says
        try:
            async with websockets.connect(url, subprotocols=[protocol], proxy=None, **options) as socket:  # type: ignore[arg-type]
                return bool(await asyncio.wait_for(socket.recv(), 20))
        except websockets.InvalidStatus as refusal:
            assert refusal.response.status_code == 403
            return False

    return asyncio.run(first())


def test_viewers_of_the_page_and_programs_are_answered(server: Server) -> None:
    port = server.get_port()
    assert connects(server, origin=f"http://127.0.0.1:{port}")
    assert connects(server, host="localhost", origin=f"http://localhost:{port}")
    assert connects(server)
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as page:
        assert b"<html" in page.read()


def test_other_websites_are_refused(server: Server) -> None:
    port = server.get_port()
    for origin in ("http://evil.example", "http://127.0.0.1:1", f"http://127.0.0.1.evil.example:{port}", "null"):
        assert not connects(server, origin=origin), origin
    # a name service that says evil.example were this computer
    assert not connects(server, host="evil.example", origin=f"http://evil.example:{port}")
    request = urllib.request.Request(f"http://127.0.0.1:{port}/", headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=20)


def test_where_others_may_come_the_page_has_any_name_but_one() -> None:
    assert not foreign({"Host": "robot.lab:8080", "Origin": "http://robot.lab:8080"}, local=False)
    assert foreign({"Host": "robot.lab:8080", "Origin": "http://robot.lab:8080"}, local=True)
    assert foreign({"Host": "robot.lab:8080", "Origin": "http://evil.example:8080"}, local=False)
    assert not foreign({"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}, local=True)
    assert foreign({}, local=True) and foreign({"Host": "[::1"}, local=True)


def test_nothing_is_shared_with_a_public_address(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *arguments: asked.append(arguments))
    assert server.request_share_url() is None  # what viser does for a viewer who asks
    assert not asked


def test_viser_starts_its_other_servers_as_ever(server: Server) -> None:
    assert websockets.asyncio.server.serve.__module__ == "websockets.asyncio.server"
