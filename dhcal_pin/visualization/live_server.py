"""Server process of a live scene: the MeshCat server on the loopback address, until its parent ends.

The server of MeshCat listens on every address and answers everyone. This one receives commands through a
socket file in a folder that only this user can open, and answers the browsers that `loopback` admits. `python
-m dhcal_pin.visualization.live_server ADDRESS` prints the address of the page as its first line.
"""

from __future__ import annotations

import re
import sys
from functools import partial

import tornado.web
from meshcat.servers.zmqserver import VIEWER_ROOT, WebSocketHandler, ZMQWebSocketBridge

from ..loopback import LOOPBACK, local_application, new_token

_SCRIPT = "main.min.js"
# As the page of MeshCat, but the connection has the token.
_PAGE = f"""<!DOCTYPE html>
<html>
<head><meta charset="utf-8"><title>dhcal</title></head>
<body style="margin: 0">
<div id="meshcat-pane" style="width: 100vw; height: 100vh; overflow: hidden"></div>
<script src="{_SCRIPT}"></script>
<script>
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
viewer.connect(`ws://${{location.host}}${{location.pathname}}socket`);
</script>
</body>
</html>
"""


class _PageHandler(tornado.web.RequestHandler):
    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.write(_PAGE)


class _LocalBridge(ZMQWebSocketBridge):
    def make_app(self) -> tornado.web.Application:
        self.token = new_token()
        app = local_application(
            self.token,
            [
                ("", _PageHandler),
                (f"({re.escape(_SCRIPT)})", tornado.web.StaticFileHandler, {"path": VIEWER_ROOT}),
                ("socket", WebSocketHandler, {"bridge": self}),
            ],
        )
        app.listen = partial(app.listen, address=LOOPBACK)
        return app


def main(address: str) -> None:
    """Serve until standard input closes, which happens when the parent process ends in any way."""
    bridge = _LocalBridge(zmq_url=address, host=LOOPBACK)
    bridge.ioloop.add_handler(sys.stdin, lambda *_: bridge.ioloop.stop(), bridge.ioloop.READ)
    print(f"http://{LOOPBACK}:{bridge.fileserver_port}/{bridge.token}/", flush=True)
    bridge.run()


if __name__ == "__main__":
    main(sys.argv[1])
