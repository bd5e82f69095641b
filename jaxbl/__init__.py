"""Motor drives with gear backlash, simulated by the thousand: observers, gain maps, identification, diagnosis.

The public names are loaded on first use, so that `import jaxbl` and the command line's help do not wait for JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .chain import (
        Experiment as Experiment,
        Run as Run,
        Sample as Sample,
        Signals as Signals,
        State as State,
        initial_state as initial_state,
    )
    from .config import Config as Config, read_config as read_config
    from .control import (
        AbstractController as AbstractController,
        AbstractReference as AbstractReference,
        Cascade as Cascade,
        ControllerState as ControllerState,
        Moves as Moves,
        Ramp as Ramp,
        RecordedReference as RecordedReference,
        SineReference as SineReference,
        StateFeedback as StateFeedback,
        StepsReference as StepsReference,
    )
    from .diagnosis.diagnose import Diagnosis as Diagnosis, diagnose as diagnose
    from .drive import (
        AbstractDrive as AbstractDrive,
        DeadZone as DeadZone,
        Encoders as Encoders,
        Initial as Initial,
        LinearShaft as LinearShaft,
        Rigid as Rigid,
        SigmoidBacklash as SigmoidBacklash,
        TwoInertia as TwoInertia,
    )
    from .drive.excitation import (
        Chirp as Chirp,
        Multisine as Multisine,
        Prbs as Prbs,
        Recorded as Recorded,
        Sine as Sine,
        Steps as Steps,
    )
    from .errors import InputError as InputError, NoResult as NoResult
    from .estimation.element import ElementIdentification as ElementIdentification, identify_element as identify_element
    from .estimation.identify import Identification as Identification, identify as identify
    from .exports import Export as Export, export as export
    from .functions import (
        Grid as Grid,
        experiment as experiment,
        metrics as metrics,
        observe as observe,
        register as register,
        samples as samples,
        simulate as simulate,
        step as step,
        sweep_arrays as sweep_arrays,
        with_values as with_values,
    )
    from .gains.accuracy_laws import Law as Law, accuracy_laws as accuracy_laws
    from .gains.tune import Tuning as Tuning, tune as tune
    from .gains.verify import Verdict as Verdict, verify as verify
    from .monitoring.watch import Watch as Watch, watch as watch
    from .observer import (
        AbstractObserver as AbstractObserver,
        DirtyDerivative as DirtyDerivative,
        Estimate as Estimate,
        ExplicitSuperTwisting as ExplicitSuperTwisting,
        ExtendedState as ExtendedState,
        ImplicitSuperTwisting as ImplicitSuperTwisting,
        Kalman as Kalman,
        Luenberger as Luenberger,
        Observers as Observers,
        ObserverState as ObserverState,
    )
    from .quantity import Quantity as Quantity
    from .records import (
        Inspection as Inspection,
        LogTable as LogTable,
        Record as Record,
        inspect as inspect,
        read_record as read_record,
    )
    from .report.results import describe as describe, draw as draw, write_report as write_report
    from .sweeps.compare import Comparison as Comparison, compare as compare
    from .sweeps.status import Status as Status, status as status
    from .sweeps.sweep import (
        StudyResult as StudyResult,
        dry_run as dry_run,
        open_study as open_study,
        repair as repair,
        share as share,
        submit as submit,
        sweep as sweep,
    )
    from .sweeps.trial import Trial as Trial, run as run
    from .throughput import bench as bench

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
