"""The TOML study: its tables, their validation, and the experiment that they describe."""

from .gains import (
    LOOP_OBJECTIVES as LOOP_OBJECTIVES,
    TUNE_NAMES as TUNE_NAMES,
    SideCertificateTable as SideCertificateTable,
    TuneTable as TuneTable,
)
from .reading import (
    ConfigSource as ConfigSource,
    read_config as read_config,
    read_log_config as read_log_config,
    read_model as read_model,
    with_values as with_values,
)
from .study import (
    KIND_PATH as KIND,
    Config as Config,
    numeric_paths as numeric_paths,
    precision as precision,
    prepare as prepare,
)
from .sweep import (
    DEFAULT_TOLERANCE as TOLERANCE,
    AxisTable as AxisTable,
    FigureTable as FigureTable,
    is_boolean as is_boolean,
)
