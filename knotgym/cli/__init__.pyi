from .inspection import print_summary as print_summary
from .options import EXISTING as EXISTING
from .options import Given as Given
from .options import command as command
from .options import run_folder as run_folder
from .program import application as application
from .program import commands as commands
from .program import main as main
