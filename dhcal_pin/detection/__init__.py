"""Boards in images, and boards to print.

`detect_corners` finds the corners of a board in images with OpenCV, which the extra `camera` installs. A
board that was printed with rows and columns exchanged, or in the older layout of OpenCV, is found, too.
`detect_boards` does so for all images of a camera.
`board_pdf` draws a board at its true scale. `render_images` renders images of boards, for tests and where no
camera is at hand.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
