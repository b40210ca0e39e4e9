"""The process behind a live scene: MeshCat's server on the loopback address, until its parent goes.

MeshCat's own listens on every address. This one takes commands through a socket file in a folder that
only this user can open, and shows its page to browsers on this computer. `python -m
dhcal_pin.live_server ADDRESS` writes the page's URL as its first line.
"""

from __future__ import annotations

import sys
from functools import partial

import tornado.web
from meshcat.servers.zmqserver import ZMQWebSocketBridge

LOOPBACK = "127.0.0.1"


class _LocalBridge(ZMQWebSocketBridge):
    def make_app(self) -> tornado.web.Application:
        app = super().make_app()
        app.listen = partial(app.listen, address=LOOPBACK)
        return app


def main(address: str) -> None:
    """Serves until standard input closes, as it does however the parent ends."""
    bridge = _LocalBridge(zmq_url=address, host=LOOPBACK)
    bridge.ioloop.add_handler(sys.stdin, lambda *_: bridge.ioloop.stop(), bridge.ioloop.READ)
    print(bridge.web_url, flush=True)
    bridge.run()


if __name__ == "__main__":
    main(sys.argv[1])
