"""What is simulated: plant, transmission laws, effects, excitation, encoders."""

from .effects import EFFECTS as EFFECTS
from .effects import AbstractEffect as AbstractEffect
from .effects import make_effect as make_effect
from .encoders import Encoders as Encoders
from .excitation import EXCITATIONS as EXCITATIONS
from .excitation import AbstractExcitation as AbstractExcitation
from .parameters import as_arrays as as_arrays
from .parameters import get_leaf as get_leaf
from .parameters import key_of as key_of
from .parameters import leaf_paths as leaf_paths
from .parameters import parameters as parameters
from .parameters import set_leaves as set_leaves
from .plant import DRIVES as DRIVES
from .plant import AbstractDrive as AbstractDrive
from .plant import Initial as Initial
from .plant import Plant as Plant
from .plant import PlantState as PlantState
from .plant import Rigid as Rigid
from .plant import TwoInertia as TwoInertia
from .transmission import TRANSMISSIONS as TRANSMISSIONS
from .transmission import AbstractTransmission as AbstractTransmission
from .transmission import DeadZone as DeadZone
from .transmission import LinearShaft as LinearShaft
from .transmission import SigmoidBacklash as SigmoidBacklash
