from .scale_gauge import ScaleGauge as ScaleGauge
from .scale_gauge import normalize_by_scale as normalize_by_scale
from .volume import contact_bias as contact_bias
from .volume import log_volume as log_volume
