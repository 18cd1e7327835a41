"""Names and ports to addresses, and what cannot be one."""

import socket

import pytest

from bipedtrack import addresses
from bipedtrack.messages import Refusal


@pytest.mark.parametrize(
    ("host", "loopback"), [("127.0.0.1", True), ("127.0.0.2", True), ("localhost", True), ("0.0.0.0", False)]
)
@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_whether_this_computer_alone_reaches_an_address(host: str, loopback: bool, kind: socket.SocketKind) -> None:
    found = addresses.resolve(host, 0, kind)
    assert found and all(address.is_loopback == loopback for address in found)
    with found[0].bind() as bound:
        assert bound.type == kind and bound.getsockname()[1] > 0


def test_an_address_may_name_its_interface() -> None:
    link_local = addresses.Address(socket.AF_INET6, socket.SOCK_STREAM, ("fe80::1%eth0", 80, 0, 2))
    assert not link_local.is_loopback


@pytest.mark.parametrize("host", ["no such host", "127.0.0..1", "a" * 64 + ".example", "999.0.0.1"])
def test_what_is_no_address_is_refused(host: str) -> None:
    with pytest.raises(Refusal, match="--host .*: .*; wanted an address of this"):
        addresses.resolve(host, 80, socket.SOCK_STREAM)


def test_a_port_that_is_taken_cannot_be_bound_again() -> None:
    (address, *_) = addresses.resolve("127.0.0.1", 0, socket.SOCK_STREAM)
    with address.bind() as first:
        first.listen()
        with pytest.raises(OSError):
            address._replace(address=first.getsockname()).bind(reuse=True)


def test_a_url_puts_ipv6_into_brackets() -> None:
    assert addresses.url("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert addresses.url("::1", 8080) == "http://[::1]:8080"
