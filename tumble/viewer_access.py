"""Access to the viewer's page: only for who has the address with the token, and for no other page in the same browser.

Every page that is open in a browser can send requests to servers on the user's machine. A request is answered only if
its path begins with the token, its header `Host` names this machine (a domain that an attacker redirects to this
machine has another name), and its header `Origin`, which browsers add, is the viewer's own page.
"""

import contextlib
import errno
import hmac
import importlib
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterator
from dataclasses import replace
from http import HTTPStatus
from typing import Any

N_PORTS = 100
"""Number of ports that are tried, from the requested one on."""


def new_token() -> str:
    """A random path for the page, which cannot be guessed."""
    return secrets.token_urlsafe(16)


def bind(host: str, port: int) -> socket.socket:
    """A socket that listens on the first free port from `port` on; 0 lets the system choose.

    Raises:
        ValueError: The port is out of range, or the host is unknown.
        OSError: The host is not this machine, or no port is free or permitted.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port is out of range: {port}; give a number from 0 to 65535")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (socket.gaierror, UnicodeError) as error:
        raise ValueError(
            f"--host {host} is unknown: {error}; leave it out, or give an address of this machine"
        ) from None
    last = min(port + N_PORTS, 65536) - 1
    for attempt in range(port, last + 1):
        try:
            return socket.create_server((address[0], attempt), family=family)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                reason = f"cannot listen on port {attempt} of {host}: {error.strerror}"
                raise OSError(f"{reason}; choose another with --port, or leave --host out") from None
    raise OSError(f"ports {port} to {last} of {host} are in use; choose another with --port")


@contextlib.contextmanager
def guarded(listening: socket.socket, host: str, token: str) -> Iterator[None]:
    """Context in which viser starts its server: on a bound socket, and behind the check of every request.

    viser has no option for either, so that its call of `websockets.asyncio.server.serve` is intercepted.

    Args:
        listening: The socket; it is closed if the server does not start.
        host: Name or address under which the user reaches the server.
        token: First part of the path of every request.

    Raises:
        ModuleNotFoundError: This version of viser started its server in another way, and so without the check.
    """
    library: Any = importlib.import_module("websockets.asyncio.server")
    original, started = library.serve, []

    def serve(handler: Any, *_: Any, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if reason := refusal(request.path, request.headers, host, token):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            answer = process_request(connection, replace(request, path=request.path.removeprefix(f"/{token}") or "/"))
            if answer is not None:
                answer.headers["Referrer-Policy"] = "no-referrer"  # links in the page must not tell the token
            return answer

        started.append(handler)
        return original(handler, sock=listening, process_request=checked, **options)

    library.serve = serve
    try:
        yield
    finally:
        library.serve = original
        if not started:
            listening.close()
    if not started:
        raise ModuleNotFoundError("this version of viser starts its server in another way: pip install 'viser~=1.1'")


def refusal(path: str, headers: Any, host: str, token: str) -> str:
    """Why a request is refused; "" if it is not.

    Args:
        path: Path of the request, with its query.
        headers: Headers of the request, with a method `get_all`.
        host: Name or address under which the user reaches the server, besides those of every machine.
        token: First part of the path of every request.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_this_machine(hosts[0], host):
        return "the header Host does not name this machine"
    if any(origin.lower() not in (f"http://{hosts[0]}".lower(), f"https://{hosts[0]}".lower()) for origin in origins):
        return "the header Origin names another page"
    first = path.partition("?")[0].removeprefix("/").partition("/")[0]
    if not hmac.compare_digest(first.encode(), token.encode()):
        return "open the address that tumble view printed"
    return ""


def _is_this_machine(header: str, host: str) -> bool:
    """Whether a header `Host` holds an IP address, `localhost`, the machine's name, or `host`; with or without port.

    Addresses are safe because nobody can redirect them to another machine, unlike the names of domains.
    """
    name = re.sub(r":\d*$", "", header).strip("[]").lower()
    if name in ("localhost", socket.gethostname().lower(), host.lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
