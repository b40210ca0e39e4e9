"""Public names of dhcal_pin.identifiability; `__init__.py` loads each on first use."""

from .explanations import EXPECTED as EXPECTED
from .explanations import explain_unknown_size as explain_unknown_size
from .explanations import explain_unobservable as explain_unobservable
from .explanations import explain_weakly_observable as explain_weakly_observable
from .explanations import label_unobservable as label_unobservable
from .observability import correlation as correlation
from .observability import observability_indices as observability_indices
from .observability import observable_fraction as observable_fraction
