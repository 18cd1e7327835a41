"""Drives the robot in a browser, in MuJoCo C at real time: a page on 127.0.0.1 that needs no other address.

python -m bipedtrack.play
python -m bipedtrack.play runs/quick-0 --port 8081
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import importlib.util
import os
import pathlib
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import tyro

from bipedtrack import addresses, paths
from bipedtrack.messages import Refusal, fail

if TYPE_CHECKING:
    from bipedtrack.page import Page

# One core is enough for the controller; a BLAS with more threads makes its small products wait for one another.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclasses.dataclass(frozen=True)
class Play:
    """Serves a page on which the robot is driven; Ctrl-C ends it."""

    policy: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """A policy file or a run directory. Default: the policy that ships."""
    host: str = "127.0.0.1"
    """The address to listen at. Any other than this one lets other machines in."""
    port: int = 8080
    """The port to listen at."""


def shipped() -> dict[str, pathlib.Path]:
    """The policies that come with the package, by name, `best` first."""
    found = {path.stem: path for path in sorted((paths.data_dir("models") / "policies").glob("*.npz"))}
    return {name: found[name] for name in sorted(found, key=lambda name: (name != "best", name))}


def choice(given: pathlib.Path | None) -> dict[str, pathlib.Path]:
    """The policies to choose from, by name; the given one comes first. Raises Refusal where there is none."""
    ready = shipped()
    if given is not None:
        name = given.stem if given.suffix == ".npz" else given.name
        ready = {name if name not in ready else str(given): given, **ready}
    if not ready:
        raise Refusal("no policy comes with this installation; wanted the path of one")
    return ready


def require_free(host: str, port: int) -> bool:
    """Whether this computer alone reaches the address. Raises Refusal where nobody can listen: it is unknown or taken."""
    if not 1 <= port <= 65535:
        raise Refusal(f"--port {port}: must be from 1 to 65535")
    found = addresses.resolve(host, port, socket.SOCK_STREAM)
    try:
        for address in found:
            address.bind(reuse=True).close()
    except OSError as error:
        raise Refusal(f"{host}:{port}: cannot listen there ({error.strerror}); wanted another --port or --host") from None
    return all(address.is_loopback for address in found)


@contextlib.contextmanager
def serve(options: Play) -> Iterator[Page]:
    """A page with a robot that is ready to be driven, until the context ends. Raises Refusal or OSError."""
    from bipedtrack import policy
    from bipedtrack.drive import Drive
    from bipedtrack.page import Page, in_loop
    from bipedtrack.realtime import RealTime
    from bipedtrack.server import Server

    local = require_free(options.host, options.port)
    if not local:
        print(f"bipedtrack: --host {options.host}: whoever reaches this machine can drive the robot", file=sys.stderr)
    policies = choice(options.policy)
    loaded = policy.load_for_simulation(next(iter(policies.values())))
    clock = RealTime(Drive(policy.Controller(loaded)))
    server = Server(options.host, options.port, local)
    clock.start()
    try:
        if server.get_port() != options.port:  # viser takes another one where somebody was faster
            raise Refusal(f"{options.host}:{options.port}: somebody else listens there now; wanted another --port")
        page = in_loop(server, lambda: Page(server, clock, policies))
        drawing = threading.Thread(target=page.run, name="drawing", daemon=True)
        drawing.start()
        gc.collect()
        gc.freeze()  # to go through all that has been imported stops every thread for 50 ms, again and again
        try:
            yield page
        finally:
            page.stop()
            drawing.join(timeout=5)
    finally:
        clock.stop()
        server.stop()


def main() -> None:
    """The command line. Exit status 0 after Ctrl-C; 2 for bad input."""
    options = tyro.cli(Play, prog="python -m bipedtrack.play")
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    if importlib.util.find_spec("viser") is None:
        fail("the page needs viser; wanted `pip install '.[play]'` in its clone")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs would ignore Ctrl-C's signal
    try:
        with contextlib.suppress(KeyboardInterrupt), serve(options):
            print(f"drive the robot at {addresses.url(options.host, options.port)} (Ctrl-C ends)", flush=True)
            while True:
                time.sleep(0.5)  # a signal that another thread got is handled when this one wakes
    except (Refusal, OSError) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
