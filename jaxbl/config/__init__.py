"""The TOML study: its tables, their validation, and the experiment that they describe."""

from .gains import TUNE_NAMES as TUNE_NAMES
from .gains import SideCertificateTable as SideCertificateTable
from .gains import TuneTable as TuneTable
from .reading import ConfigSource as ConfigSource
from .reading import read_config as read_config
from .reading import read_log_config as read_log_config
from .reading import read_model as read_model
from .reading import with_values as with_values
from .study import KIND_PATH as KIND
from .study import Config as Config
from .study import numeric_paths as numeric_paths
from .study import precision as precision
from .study import prepare as prepare
from .sweep import DEFAULT_TOLERANCE as TOLERANCE
from .sweep import AxisTable as AxisTable
from .sweep import FigureTable as FigureTable
from .sweep import is_boolean as is_boolean
