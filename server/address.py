"""Opens the socket at which the service listens, and recognises this machine's own addresses."""

import errno
import ipaddress
import socket

from rig.errors import EigenheadError


class AddressTaken(EigenheadError):
    """Reports that the service cannot listen at an address: another program uses it or it is not this machine's."""

    def __init__(self, host: str, port: int, error: OSError) -> None:
        who = "another program listens there" if error.errno == errno.EADDRINUSE else error.strerror or str(error)
        super().__init__(f"cannot listen on {host}:{port}: {who}; name another with --host and --port, or stop it")


def listen(host: str, port: int) -> socket.socket:
    """Opens a listening socket. Port 0 chooses a free port. Raises AddressTaken."""
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
    """Returns whether only this machine can reach a host name or address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
