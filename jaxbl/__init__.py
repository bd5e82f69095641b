"""Drives with backlash, thousands at once: observation, gain maps, identification.

The public names are loaded on first use, so that `import jaxbl` and the command line's help do not wait for JAX.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .errors import InputError as InputError
    from .errors import NoResult as NoResult
    from .records import Inspection as Inspection
    from .records import LogTable as LogTable
    from .records import Record as Record
    from .records import inspect as inspect
    from .records import read_record as read_record
    from .report.atlas import write_verify_report as write_verify_report
    from .report.diagnosed import write_diagnosis_report as write_diagnosis_report
    from .report.identified import write_identification_report as write_identification_report
    from .report.inspected import write_inspection_report as write_inspection_report
    from .report.reports import write_sweep_report as write_sweep_report
    from .report.reports import write_trial_report as write_trial_report
    from .report.tuning import write_tune_report as write_tune_report
    from .study.config import Config as Config
    from .study.config import read_config as read_config
    from .study.diagnosis import Diagnosis as Diagnosis
    from .study.diagnosis import diagnose as diagnose
    from .study.identification import Identification as Identification
    from .study.identification import identify as identify
    from .study.laws import Law as Law
    from .study.laws import accuracy_laws as accuracy_laws
    from .study.sweep import StudyResult as StudyResult
    from .study.sweep import dry_run as dry_run
    from .study.sweep import load as load
    from .study.sweep import sweep as sweep
    from .study.trial import Trial as Trial
    from .study.trial import run as run
    from .study.tune import Tuning as Tuning
    from .study.tune import tune as tune
    from .study.verify import Verdict as Verdict
    from .study.verify import verify as verify
    from .throughput import bench as bench

_WHERE = {
    "InputError": "errors",
    "NoResult": "errors",
    "Inspection": "records",
    "LogTable": "records",
    "Record": "records",
    "inspect": "records",
    "read_record": "records",
    "write_diagnosis_report": "report.diagnosed",
    "write_identification_report": "report.identified",
    "write_inspection_report": "report.inspected",
    "write_sweep_report": "report.reports",
    "write_trial_report": "report.reports",
    "write_tune_report": "report.tuning",
    "write_verify_report": "report.atlas",
    "Config": "study.config",
    "read_config": "study.config",
    "Diagnosis": "study.diagnosis",
    "diagnose": "study.diagnosis",
    "Identification": "study.identification",
    "identify": "study.identification",
    "Law": "study.laws",
    "accuracy_laws": "study.laws",
    "StudyResult": "study.sweep",
    "dry_run": "study.sweep",
    "load": "study.sweep",
    "sweep": "study.sweep",
    "Trial": "study.trial",
    "run": "study.trial",
    "Tuning": "study.tune",
    "tune": "study.tune",
    "bench": "throughput",
    "Verdict": "study.verify",
    "verify": "study.verify",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'jaxbl' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f".{_WHERE[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(_WHERE)
