"""Figures and reports."""

from .atlas import write_verify_report as write_verify_report
from .diagnosed import diagnosis_lines as diagnosis_lines
from .diagnosed import write_diagnosis_report as write_diagnosis_report
from .identified import identification_lines as identification_lines
from .identified import write_identification_report as write_identification_report
from .inspected import write_inspection_report as write_inspection_report
from .maps import draw as draw
from .reports import write_sweep_report as write_sweep_report
from .reports import write_trial_report as write_trial_report
from .tuning import write_tune_report as write_tune_report
