from .photo import photograph as photograph
from .rope_reader import RopeReader as RopeReader
from .rope_reader import inference as inference
from .strand_network import StrandNetwork as StrandNetwork
