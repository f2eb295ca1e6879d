from .photo import photograph as photograph
from .pictures import is_picture as is_picture
from .pictures import open_picture as open_picture
from .pictures import overlay as overlay
from .rope_reader import PhotoReading as PhotoReading
from .rope_reader import RopeReader as RopeReader
from .rope_reader import inference as inference
from .strand_network import StrandNetwork as StrandNetwork
