"""Public names of dhcal_pin.io.measurement_files; `__init__.py` loads each on first use."""

from .image_joints import ImageJoints as ImageJoints
from .image_joints import read_image_joints as read_image_joints
from .image_joints import read_joint_table as read_joint_table
from .image_times import read_recorded_joints as read_recorded_joints
from .parts import Part as Part
from .parts import iter_measurements as iter_measurements
from .reading import MeasurementFile as MeasurementFile
from .reading import read_measurement_file as read_measurement_file
from .reading import read_measurements as read_measurements
from .targets import TargetPoses as TargetPoses
from .targets import read_configurations as read_configurations
from .targets import read_targets as read_targets
from .writing import configurations_text as configurations_text
from .writing import measurement_text as measurement_text
