from .rope_weights import load_rope_reader as load_rope_reader
from .rope_weights import read_photo as read_photo
from .rope_weights import save_rope_reader as save_rope_reader
from .trials import Trials as Trials
