from .options import EXISTING as EXISTING
from .options import Given as Given
from .options import command as command
from .program import application as application
from .program import main as main
