"""Motor drives with gear backlash, simulated by the thousand: observers, gain maps, identification, diagnosis.

The public names are loaded on first use, so that `import jaxbl` and the command line's help do not wait for JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .chain import Experiment, Run, Sample, Signals, State, initial_state
    from .config import Config, read_config
    from .control import (
        AbstractController,
        AbstractReference,
        Cascade,
        ControllerState,
        Moves,
        Ramp,
        RecordedReference,
        SineReference,
        StateFeedback,
        StepsReference,
    )
    from .diagnosis.diagnose import Diagnosis, diagnose
    from .drive import AbstractDrive, DeadZone, Encoders, Initial, LinearShaft, Rigid, SigmoidBacklash, TwoInertia
    from .drive.excitation import Chirp, Multisine, Prbs, Recorded, Sine, Steps
    from .errors import InputError, NoResult
    from .estimation.element import ElementIdentification, identify_element
    from .estimation.identify import Identification, identify
    from .exports import Export, export
    from .functions import Grid, experiment, metrics, observe, register, samples, simulate, step, sweep_arrays, with_values
    from .gains.accuracy_laws import Law, accuracy_laws
    from .gains.tune import Tuning, tune
    from .gains.verify import Verdict, verify
    from .monitoring.watch import Watch, watch
    from .observer import (
        AbstractObserver,
        DirtyDerivative,
        Estimate,
        ExplicitSuperTwisting,
        ExtendedState,
        ImplicitSuperTwisting,
        Kalman,
        Luenberger,
        Observers,
        ObserverState,
    )
    from .quantity import Quantity
    from .records import Inspection, LogTable, Record, inspect, read_record
    from .report.results import describe, draw, write_report
    from .sweeps.compare import Comparison, compare
    from .sweeps.status import Status, status
    from .sweeps.sweep import StudyResult, dry_run, open_study, repair, share, submit, sweep
    from .sweeps.trial import Trial, run
    from .throughput import bench

# the same for loading; a test compares the two
_NAMES = {
    "chain": "Experiment Run Sample Signals State initial_state",
    "config": "Config read_config",
    "control": (
        "AbstractController AbstractReference Cascade ControllerState Moves Ramp RecordedReference SineReference "
        "StateFeedback StepsReference"
    ),
    "diagnosis.diagnose": "Diagnosis diagnose",
    "drive": "AbstractDrive DeadZone Encoders Initial LinearShaft Rigid SigmoidBacklash TwoInertia",
    "drive.excitation": "Chirp Multisine Prbs Recorded Sine Steps",
    "errors": "InputError NoResult",
    "exports": "Export export",
    "functions": "Grid experiment metrics observe register samples simulate step sweep_arrays with_values",
    "gains.accuracy_laws": "Law accuracy_laws",
    "gains.tune": "Tuning tune",
    "gains.verify": "Verdict verify",
    "estimation.element": "ElementIdentification identify_element",
    "estimation.identify": "Identification identify",
    "monitoring.watch": "Watch watch",
    "observer": (
        "AbstractObserver DirtyDerivative Estimate ExplicitSuperTwisting ExtendedState ImplicitSuperTwisting Kalman "
        "Luenberger Observers ObserverState"
    ),
    "quantity": "Quantity",
    "records": "Inspection LogTable Record inspect read_record",
    "report.results": "describe draw write_report",
    "sweeps.compare": "Comparison compare",
    "sweeps.status": "Status status",
    "sweeps.sweep": "StudyResult dry_run open_study repair share submit sweep",
    "sweeps.trial": "Trial run",
    "throughput": "bench",
}
_WHERE = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'jaxbl' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(_WHERE)
