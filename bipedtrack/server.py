"""viser's server without what it would open to strangers: no public address, no other website that drives the robot.

viser offers every viewer to share the page through a public address, and takes messages from any website that is open in the
browser of somebody who reaches it.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server


class Server(viser.ViserServer):
    """Listens at once; the page has no share button, and a viewer who asks for a public address all the same gets none."""

    def __init__(self, host: str, port: int, local: bool):
        """local: whether this computer alone reaches the host."""
        with _refusing_foreign_requests(local):
            super().__init__(host, port, verbose=False)
        self.gui.configure_theme(show_share_button=False)

    def request_share_url(self, verbose: bool = True) -> None:
        """None: nothing is shared."""


def foreign(headers: Mapping[str, str], local: bool) -> bool:
    """Whether a request comes from another website than this page.

    headers: of the request. A browser names the website that asks as Origin, and the one that it believes to ask as Host;
    what is no browser sends no Origin. local: this computer alone is to be reached, so that a Host that is another name came
    by a name service that lies.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    return (origin is not None and urlsplit(origin).netloc != host) or (local and not _is_this_computer(host))


def _is_this_computer(host: str) -> bool:
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


@contextlib.contextmanager
def _refusing_foreign_requests(local: bool) -> Iterator[None]:
    """A server that viser starts meanwhile answers foreign requests with 403: viser has no option for it."""
    serve = websockets.asyncio.server.serve

    def refusing(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if foreign(request.headers, local):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "the page is for its own viewers\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    websockets.asyncio.server.serve = refusing  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
