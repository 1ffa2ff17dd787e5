"""Where the service listens."""

import errno
import ipaddress
import socket

from rig.errors import EigenheadError


class AddressTaken(EigenheadError):
    """Another program listens there, or the address is not this machine's."""

    def __init__(self, host: str, port: int, error: OSError) -> None:
        who = "another program listens there" if error.errno == errno.EADDRINUSE else error.strerror or str(error)
        super().__init__(f"cannot listen on {host}:{port}: {who}; name another with --host and --port, or stop it")


def listen(host: str, port: int) -> socket.socket:
    """Opens a listening socket; port 0 takes a free one. Raises AddressTaken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((host, port))
        sock.listen(1024)
    except OSError as error:
        sock.close()
        raise AddressTaken(host, port, error) from error
    return sock


def is_loopback(host: str) -> bool:
    """Tells whether a host name or address is this machine's own."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
