"""Robot models: kinematic chains, DH tables, URDF files, transmissions, inverse kinematics."""

from .chain import BASE_FRAME, Chain, extract_dh_table, joint_frame, link_frame
from .collision import CollisionChecker
from .dh import Convention, DHTable
from .dh_extraction import Extraction, extract_dh
from .dh_urdf import dh_to_urdf
from .sampling import ConfigurationSampler, WorkspaceConstraints, joint_range
from .transmission import Payload, Transmission
from .urdf import Urdf, parse_urdf, read_urdf

__all__ = [
    "BASE_FRAME",
    "Chain",
    "CollisionChecker",
    "ConfigurationSampler",
    "Convention",
    "DHTable",
    "Extraction",
    "Payload",
    "Transmission",
    "Urdf",
    "WorkspaceConstraints",
    "dh_to_urdf",
    "extract_dh",
    "extract_dh_table",
    "joint_frame",
    "joint_range",
    "link_frame",
    "parse_urdf",
    "read_urdf",
]
