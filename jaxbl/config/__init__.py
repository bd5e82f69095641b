"""The TOML study: its tables, their validation, and the experiment that they describe."""

from .gains import LOOP_OBJECTIVES, TUNE_NAMES, SideCertificateTable, TuneTable
from .reading import ConfigSource, read_config, read_log_config, read_model, with_values
from .study import KIND_PATH as KIND, Config, numeric_paths, precision, prepare
from .sweep import DEFAULT_TOLERANCE as TOLERANCE, AxisTable, FigureTable, is_boolean
