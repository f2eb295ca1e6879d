from .curves import drawn_curve as drawn_curve
from .drawing_config import DrawingConfig as DrawingConfig
