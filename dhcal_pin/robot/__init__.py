"""Robot models: kinematic chains, DH tables, URDF files, joint transmissions, inverse kinematics.

This package holds what is known about a robot without measurements. Error parameters and their estimation
belong to `estimation`; reading and writing of files other than URDF belongs to `io`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
