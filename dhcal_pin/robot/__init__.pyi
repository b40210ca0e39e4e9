"""Public names of dhcal_pin.robot; `__init__.py` loads each on first use."""

from .chain import BASE_FRAME as BASE_FRAME
from .chain import Chain as Chain
from .chain import extract_dh_table as extract_dh_table
from .chain import joint_frame as joint_frame
from .chain import link_frame as link_frame
from .collision import CollisionChecker as CollisionChecker
from .dh import Convention as Convention
from .dh import DHTable as DHTable
from .dh_extraction import Extraction as Extraction
from .dh_extraction import extract_dh as extract_dh
from .dh_urdf import dh_to_urdf as dh_to_urdf
from .error_families import FAMILIES as FAMILIES
from .error_families import ErrorFamily as ErrorFamily
from .sampling import ConfigurationSampler as ConfigurationSampler
from .sampling import WorkspaceConstraints as WorkspaceConstraints
from .sampling import joint_range as joint_range
from .transmission import GravityLoads as GravityLoads
from .transmission import Payload as Payload
from .transmission import Transmission as Transmission
from .urdf import Urdf as Urdf
from .urdf import UrdfJoint as UrdfJoint
from .urdf import parse_urdf as parse_urdf
from .urdf import read_urdf as read_urdf
