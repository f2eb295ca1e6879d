from .program import COMMANDS as COMMANDS
from .program import application as application
from .program import main as main
