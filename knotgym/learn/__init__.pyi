from .rope_reader import RopeReader as RopeReader
from .rope_reader import load_rope_reader as load_rope_reader
from .strand_network import StrandNetwork as StrandNetwork
from .train_config import CloneConfig as CloneConfig
from .train_config import ReaderConfig as ReaderConfig
from .train_recipe import train as train
