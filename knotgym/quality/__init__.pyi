from .limits import GRADES as GRADES
from .limits import RESET_NOISE as RESET_NOISE
from .limits import Limits as Limits
from .limits import Quality as Quality
from .limits import grade_of as grade_of
from .measures import base_spacing as base_spacing
from .measures import measure as measure
from .measures import noise_survival as noise_survival
