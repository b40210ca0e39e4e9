"""Robot models: kinematic chains, DH tables, URDF files, transmissions, inverse kinematics."""

from .chain import BASE, Chain, extract, joint_station, link_station
from .collision import Clearance
from .dh import Convention, DHTable
from .dh_extraction import Extraction, extract_dh
from .dh_urdf import dh_to_urdf
from .sampling import Room, Space, joint_range
from .transmission import Payload, Transmission
from .urdf import Urdf, parse_urdf, read_urdf

__all__ = [
    "BASE",
    "Chain",
    "Clearance",
    "Convention",
    "DHTable",
    "Extraction",
    "Payload",
    "Room",
    "Space",
    "Transmission",
    "Urdf",
    "dh_to_urdf",
    "extract",
    "extract_dh",
    "joint_range",
    "joint_station",
    "link_station",
    "parse_urdf",
    "read_urdf",
]
