from .generate_command import code_list as code_list
from .inspection import print_transcripts as print_transcripts
from .program import COMMANDS as COMMANDS
from .program import application as application
from .program import main as main
