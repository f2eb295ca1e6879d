from .generate_command import code_list as code_list
from .options import numbers as numbers
from .program import COMMANDS as COMMANDS
from .program import application as application
from .program import main as main
from .summaries import print_transcripts as print_transcripts
