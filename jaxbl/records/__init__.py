"""Read measured logs into SI units, and judge what they can identify."""

from .alignment import NominalDrive as NominalDrive
from .inspection import Inspection as Inspection, inspect as inspect
from .position_zero import TurningLog as TurningLog, find_zero_shift as find_zero_shift
from .reader import (
    Record as Record,
    check_positions as check_positions,
    join_records as join_records,
    read_log_table as read_log_table,
    read_record as read_record,
)
from .table import POSITION_CHANNELS as POSITION_CHANNELS, LogTable as LogTable
