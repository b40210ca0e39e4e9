"""Web servers for the user of this computer only: on the loopback address, with a secret in the address.

Every program and every web page on this computer can send requests to a port of the loopback address. A
server of this module therefore answers a request only if

- its path begins with a random token, which only the user's browser knows;
- its `Host` header names the loopback address. A page of another site can make its own name resolve to this
  computer (DNS rebinding); the browser then sends that name;
- a request that changes something comes from a page of this server (`is_same_origin`).

tornado compares the `Origin` header of web sockets with the `Host` header by itself.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from typing import Any

import tornado.httputil
import tornado.web

LOOPBACK = "127.0.0.1"
# Names of the loopback address that a browser may ask for.
_HOSTS = rf"({re.escape(LOOPBACK)}|localhost)"
_TOKEN_BYTES = 16


def new_token() -> str:
    """Return a random text for the address of a server, different for each server."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


@tornado.web.stream_request_body
class _UnknownAddress(tornado.web.RequestHandler):
    """Refuses a request by its header, before its body arrives."""

    def prepare(self) -> None:
        raise tornado.web.HTTPError(404)


def local_application(
    token: str, handlers: Sequence[tuple[Any, ...]], **settings: Any
) -> tornado.web.Application:
    """Create an application that answers requests for the loopback address below a token only."""
    app = tornado.web.Application(**settings, default_handler_class=_UnknownAddress)
    root = f"/{re.escape(token)}/"
    app.add_handlers(_HOSTS, [(root + pattern, *rest) for pattern, *rest in handlers])
    return app


def is_same_origin(request: tornado.httputil.HTTPServerRequest) -> bool:
    """Tell whether a page of this server has sent a request."""
    return request.headers.get("Origin") == f"{request.protocol}://{request.host}"
