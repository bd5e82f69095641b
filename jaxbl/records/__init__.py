"""Measured logs: reading them into SI units, and what they are good for."""

from .alignment import NominalDrive as NominalDrive
from .inspection import Identifiability as Identifiability
from .inspection import Inspection as Inspection
from .inspection import inspect as inspect
from .position_zero import TurningLog as TurningLog
from .position_zero import find_zero_shift as find_zero_shift
from .reader import LogStatistics as LogStatistics
from .reader import Record as Record
from .reader import check_positions as check_positions
from .reader import join_records as join_records
from .reader import read_log_table as read_log_table
from .reader import read_record as read_record
from .table import POSITION_CHANNELS as POSITION_CHANNELS
from .table import LogTable as LogTable
from .table import PositionTable as PositionTable
