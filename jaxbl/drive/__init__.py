"""What is simulated: plant, transmission laws, effects, excitation, encoders."""

from .effects import EFFECTS, AbstractEffect, make_effect
from .encoders import Encoders
from .excitation import EXCITATIONS, AbstractExcitation
from .parameters import as_arrays, config_key, get_leaf, leaf_paths, parameters, set_leaves
from .plant import DRIVES, AbstractDrive, Initial, Plant, PlantState, Rigid, TwoInertia
from .transmission import TRANSMISSIONS, AbstractTransmission, DeadZone, LinearShaft, SigmoidBacklash
