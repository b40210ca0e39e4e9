"""Web page on this computer that calibrates a robot from dropped files.

The server keeps nothing: a request brings its files and options, its answer brings progress and the results.
The calculation is the command `dhcal` in a process of its own, in a temporary folder that exists during the
request only. The page (`app.html`, `app.css`, `app.js`) shows the answers; it needs no network.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
