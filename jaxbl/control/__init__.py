"""The loop closed: controllers, and references that they follow."""

from .base import CONTROLLERS, AbstractController, ControllerState, Feedback
from .cascade import Cascade
from .references import (
    REFERENCES,
    AbstractReference,
    FunctionReference,
    Moves,
    Ramp,
    RecordedReference,
    SineReference,
    StepsReference,
    Target,
)
from .state_feedback import StateFeedback
