"""Public names of dhcal_pin.plausibility; `__init__.py` loads each on first use."""

from .diagnosis import Diagnosis as Diagnosis
from .displacement import CorrectionSize as CorrectionSize
from .displacement import measure_correction as measure_correction
from .evidence import Evidence as Evidence
from .evidence import fit_evidence as fit_evidence
from .hypotheses import JOINT_CHANGES as JOINT_CHANGES
from .hypotheses import LASTING_CHANGES as LASTING_CHANGES
from .hypotheses import Hypothesis as Hypothesis
from .hypotheses import list_hypotheses as list_hypotheses
from .hypotheses import mend as mend
from .hypotheses import mend_files as mend_files
from .hypotheses import mend_lines as mend_lines
from .mixups import diagnose_mixups as diagnose_mixups
from .signs import SignDecision as SignDecision
from .signs import decide_signs as decide_signs
from .signs import first_errors as first_errors
from .signs import known_signs as known_signs
from .signs import with_wide_limits as with_wide_limits
