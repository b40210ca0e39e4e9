"""Server process of a live scene: the MeshCat server on the loopback address, until its parent ends.

The server of MeshCat listens on every address. This one receives commands through a socket file in a folder
that only this user can open, and shows its page to browsers on this computer. `python -m
dhcal_pin.visualization.live_server ADDRESS` prints the address of the page as its first line.
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
    """Serve until standard input closes, which happens when the parent process ends in any way.

    Args:
        address: Address of the socket for commands.
    """
    bridge = _LocalBridge(zmq_url=address, host=LOOPBACK)
    bridge.ioloop.add_handler(sys.stdin, lambda *_: bridge.ioloop.stop(), bridge.ioloop.READ)
    print(bridge.web_url, flush=True)
    bridge.run()


if __name__ == "__main__":
    main(sys.argv[1])
