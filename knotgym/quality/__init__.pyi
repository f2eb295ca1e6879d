from .limits import GRADES as GRADES
from .limits import Limits as Limits
from .limits import Quality as Quality
from .limits import grade_of as grade_of
from .measures import base_spacing as base_spacing
from .measures import measure as measure
from .measures import measure_all as measure_all
from .measures import noise_survival as noise_survival
