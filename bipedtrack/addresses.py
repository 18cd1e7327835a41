"""Where a server listens, and whether others reach it there."""

from __future__ import annotations

import ipaddress
import socket
from typing import Any, NamedTuple

from bipedtrack.messages import Refusal


class Address(NamedTuple):
    """What a name and a port mean to a socket."""

    family: socket.AddressFamily
    kind: socket.SocketKind
    address: Any  # host and port as the family has them

    @property
    def is_loopback(self) -> bool:
        """Whether this computer alone reaches it."""
        return ipaddress.ip_address(self.address[0].partition("%")[0]).is_loopback

    def bind(self, reuse: bool = False) -> socket.socket:
        """A socket bound to it; reuse: also where an earlier one's last connections are still closing. Raises OSError."""
        bound = socket.socket(self.family, self.kind)
        try:
            if reuse:
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(self.address)
        except OSError:
            bound.close()
            raise
        return bound


def resolve(host: str, port: int, kind: socket.SocketKind) -> list[Address]:
    """The addresses of a host, at least one. Raises Refusal where there is none, or the name cannot be one."""
    try:
        found = socket.getaddrinfo(host, port, type=kind)
    except OSError as error:
        raise Refusal(f"--host {host}: {error.strerror}; wanted an address of this computer") from None
    except UnicodeError:  # an empty part, or one of more than 63 letters
        raise Refusal(f"--host {host}: is no name of a computer; wanted an address of this one") from None
    return [Address(family, kind, address) for family, kind, _, _, address in found]


def url(host: str, port: int) -> str:
    """Where a browser finds it."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
