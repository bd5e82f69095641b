"""Base classes of effects: hooks that a plant calls, roles of numbers, and checks of effects from other packages.

An effect is a module that overrides some hooks. The plant calls the hooks of every effect at every step; those that are
not overridden return the Python number 0.0 or their argument, which costs nothing after compilation. Each number of an
effect declares the part that it plays (:class:`Role`). Tables of a config, sweeps, identification, diagnosis, reports and
the reference need no more than these roles and a few class attributes.

Sign convention: `resist` torques are subtracted on their side, J dv/dt = ... - resist, so that a positive number always
opposes a positive drive torque.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np

from jaxbl.registry import Registry, check_text

from ..parameters import Parameter, parameter, parameters

Number = Any  # a float or an array: hooks are duck-typed, and neutral ones return the Python number 0.0
Numbers = dict[str, float]
"""Numbers of one effect, by name."""
PLACES = ("motor", "load", "transmission", "actuator", "encoder")


class Motion(NamedTuple):
    """The motion that an effect sees.

    Attributes:
        time: s.
        position: of the effect's side (of the motor for an effect of the actuator), rad. For an effect in the gear, the
            elastic deflection.
        velocity: its rate, rad/s. In :meth:`AbstractEffect.advance` of an effect in the gear, in the middle of the step.
        torque: input that acts on the motor, N m, in :meth:`AbstractEffect.resist` and
            :meth:`AbstractEffect.dry_friction` of an effect on the motor; elsewhere 0.
    """

    time: Number
    position: Number
    velocity: Number
    torque: Number = 0.0


class Scales(NamedTuple):
    """Sizes of a log's signals at the place of an effect, from which trial values of its numbers are chosen.

    Attributes:
        torque: largest input, N m.
        period: sampling period, s.
        duration: of all samples, s.
        twist: rms of z = theta_e - N_0 theta_s, rad; 0 on a rigid drive.
        largest_twist: rad.
        speed: rms velocity of the effect's side (of the motor for gear and actuator), rad/s.
        spread: standard deviation of that side's position, rad.
        travel: range of that side's position, rad; for an effect in the gear, of the load's.
        noise: standard deviation of that side's readings, rad.
        ratio: motor turns for one load turn; 1 on a rigid drive.
        harmonics: periods a turn of the waves over position that the model already has on the side.
        frequencies: of torques on the side that would explain most of the residual torque, Hz.
        waves: periods a turn of torques over the side's position that would explain most of it.
        wave_count: number of waves among which these were found.
    """

    torque: float
    period: float
    duration: float
    twist: float
    largest_twist: float
    speed: float
    spread: float
    travel: float
    noise: float
    ratio: float = 1.0
    harmonics: tuple[float, ...] = ()
    frequencies: tuple[float, ...] = ()
    waves: tuple[float, ...] = ()
    wave_count: int = 0


def multiples(scale: str, factors: Sequence[float]) -> Callable[[Scales], list[float]]:
    """Return a function that gives trial values: multiples of one of the :class:`Scales` of a log."""
    return lambda log: [factor * getattr(log, scale) for factor in factors]


class Role(NamedTuple):
    """The part that a number plays in its effect.

    Attributes:
        kind: `size`: the torque is proportional to the number. `angle`: a phase, rad. `harmonic`: a number of periods a
            turn, which is chosen among trial values and not fitted. `frequency`: Hz. `shape`: any other positive number.
            `held`: stays neutral, unless it has trial values and a diagnosis finds the law with one of them likelier.
        neutral: the number with which the effect does nothing.
        trials: the values to try on a log with some :class:`Scales`. A size has one, small enough for a linear torque.
        width: prior standard deviation: of an angle in rad, of a shape in its logarithm.
        among_waves: whether a harmonic was chosen among all waves that a log tells apart, and not among `trials` alone.
    """

    kind: Literal["size", "angle", "harmonic", "frequency", "shape", "held"]
    neutral: float
    trials: Callable[[Scales], Sequence[float]]
    width: float = 1.0
    among_waves: bool = False


def size(unit: str, doc: str, *, trial: Callable[[Scales], float] = lambda log: 1.0, **limits: Any) -> Any:
    """Declare a number that the torque is proportional to; arguments of :func:`jaxbl.drive.parameters.parameter`.

    `trial` gives its trial value on a log with some :class:`Scales`.
    """
    return parameter(unit, doc, role=Role("size", 0.0, lambda log: (trial(log),)), **limits)


def angle(doc: str) -> Any:
    """Declare a phase (rad), by default 0. Its prior is uniform over the circle: standard deviation pi / sqrt(3)."""
    return parameter("rad", doc, default=0.0, role=Role("angle", 0.0, lambda log: (0.0,), 1.8))


def harmonic(doc: str, trials: Callable[[Scales], Sequence[float]], *, among_waves: bool = False, **limits: Any) -> Any:
    """Declare a number of periods a turn, which is chosen among the values of `trials`."""
    return parameter("1/turn", doc, above=0.0, role=Role("harmonic", 1.0, trials, among_waves=among_waves), **limits)


def frequency(doc: str) -> Any:
    """Declare a frequency (Hz); tried are those at which a torque on the effect's side explains most."""
    return parameter("Hz", doc, minimum=0.0, role=Role("frequency", 1.0, lambda log: log.frequencies))


def shape(unit: str, doc: str, trials: Callable[[Scales], Sequence[float]], *, neutral: float = 1.0, **limits: Any) -> Any:
    """Declare a positive number that the torque is not proportional to: a speed, a gap, a time constant."""
    return parameter(unit, doc, role=Role("shape", neutral, trials), **limits)


def held(
    unit: str, doc: str, neutral: float, trials: Callable[[Scales], Sequence[float]] | None = None, **limits: Any
) -> Any:
    """Declare a number that is `neutral` by default. A diagnosis leaves it there unless it has `trials`; an identification
    fits it only if the study sets it or asks for it."""
    role = Role("held", neutral, (lambda log: (neutral,)) if trials is None else trials)
    return parameter(unit, doc, default=neutral, role=role, **limits)


def table(unit: str, doc: str) -> Any:
    """Declare a list of numbers, by default empty, which no axis and no fit changes."""
    return parameter(unit, doc, default=(), fixed=True)


class AbstractEffect(eqx.Module):
    """Base class of all effects; every hook is neutral unless it is overridden.

    The `state` of a hook is the effect's own: :meth:`init` makes it; :meth:`receive`, :meth:`actuate` and :meth:`advance`
    change it.

    Attributes:
        kind: its name without the place.
        places: where it may act: motor, load, transmission, actuator, encoder.
        velocity_dependent: True if a hook that gives a torque uses a velocity. It is then evaluated twice a step (predictor
            and corrector), which keeps the integrator's second order.
        state_from_input: True if its state is the commanded input, whatever its numbers and the motion.
        state_from_measurement: True if its numbers and a log's input or measured motion determine its state.
        in_time: True if it depends on the time since a log began.
        rotary: True if only a rotary motor has it: a diagnosis of a linear axis does not seek it.
        in_log: words that say how it is taken off a log, if it is an error of the recording: a diagnosis asks for it first.
        corrects: the number of the drive whose error it is: `inertia` or `viscous`.
        law_error: share of its torque by which machines depart from its law.
        exclusive: a word; a place has at most one effect with the same word.
        special_cases: simpler kinds at the same place that it contains, each with a function from its numbers to theirs.
    """

    kind = ""
    places: ClassVar[tuple[str, ...]] = ()
    velocity_dependent = False
    state_from_input = False
    state_from_measurement = False
    in_time = False
    rotary = False
    in_log = ""
    corrects: ClassVar[str | None] = None
    law_error = 0.0
    exclusive: ClassVar[str | None] = None
    special_cases: ClassVar[Mapping[str, Callable[[Numbers], Numbers]]] = {}

    @property
    def place(self) -> str:
        """The place where it acts."""
        return self.places[0]

    @property
    def name(self) -> str:
        """Full name, e.g. `load.coulomb_friction`."""
        return f"{self.place}.{self.kind}"

    def init(self) -> Any:
        """State at t = 0: a tuple of numbers (or of tuples of numbers), each a scalar array."""
        return ()

    def settled(self, torque: Number) -> Any:
        """Return the state after a commanded torque (N m) that has lasted; :meth:`init` unless it is overridden."""
        return type(self).init(self)

    def set_in_motion(self, state: Any, velocity: Number) -> Any:
        """State that :meth:`init` made, on a side that moves with `velocity` (rad/s) when a log begins."""
        return state

    def advance(self, state: Any, motion: Motion, step: Number) -> Any:
        """State after `step` seconds at a steady velocity. The plant calls it for both halves of a step."""
        return state

    def receive(self, state: Any, torque: Number, period: Number) -> tuple[Any, Number, Number, Number]:
        """Delay an input (N m) that is commanded for a sample of `period` seconds, before :meth:`actuate`.

        Returns:
            The new state, the torque that arrives first, the torque that arrives then, and the time of the change since the
            sample began (s).
        """
        return state, torque, torque, 0.0

    def actuate(self, state: Any, torque: Number, step: Number) -> tuple[Any, Number]:
        """New state, and the torque (N m) that acts over the next `step` seconds for a commanded torque (N m)."""
        return state, torque

    def transmission_error(self, state: Any, load_position: Number) -> Number:
        """Kinematic error (rad on the motor side) that is added to z = theta_e - N_0 theta_s."""
        return 0.0

    def deflect(self, state: Any, z: Number) -> Number:
        """Elastic deflection (rad) at a twist z (rad)."""
        return z

    def free_play(self) -> Number:
        """Half of the free play (rad) that :meth:`deflect` takes off a twist."""
        return 0.0

    def transmit(self, state: Any, deflection: Number, rate: Number) -> Number:
        """Torque (N m) that is added to the transmitted one, at a deflection (rad) and its rate (rad/s)."""
        return 0.0

    def resist(self, state: Any, motion: Motion) -> Number:
        """Torque (N m) that is subtracted on the effect's side."""
        return 0.0

    def dry_friction(self, state: Any, motion: Motion) -> Number:
        """Level (N m) of set-valued dry friction on the effect's side: the torque that holds it, and that opposes motion."""
        return 0.0

    def holds(self) -> Number:
        """Torque (N m) up to which :meth:`resist` may hold a side that is not seen to move.

        For a friction with a memory whose contacts bend by less than readings show, so that its state is unknown.
        """
        return 0.0

    def gear_friction(self, state: Any, torque: Number) -> Number:
        """Level (N m) of set-valued dry friction that a transmitted torque (N m) causes on the motor's side of the gear."""
        return 0.0

    def bent(self, torque: Number) -> Any:
        """State in which :meth:`resist` is nearest to a torque (N m), for an effect that :meth:`holds`."""
        return self.init()

    def read(self, position: Number, velocity: Number) -> Number:
        """Reading (rad) of an encoder at a position (rad) and velocity (rad/s), before noise and quantisation."""
        return position

    def added_inertia(self) -> Number:
        """Inertia (kg m^2) that is added to the nominal one. It is constant: one that varies needs a torque as well."""
        return 0.0

    # class methods for a diagnosis

    @classmethod
    def roles(cls, *kinds: str) -> dict[str, Role]:
        """Role of each number, or of those of some `kinds`; empty for an effect that a diagnosis does not try."""
        roles = {field.name: declaration.role for field, declaration in parameters(cls)}
        if None in roles.values():
            return {}
        return {name: role for name, role in roles.items() if not kinds or role.kind in kinds}

    @classmethod
    def neutral(cls, *kinds: str) -> Numbers:
        """Numbers with which the effect does nothing, or some `kinds` of them; empty for an effect without :meth:`roles`."""
        return {name: role.neutral for name, role in cls.roles(*kinds).items()}

    @classmethod
    def sizes(cls) -> list[str]:
        """Names of the numbers that its torque is proportional to."""
        return list(cls.roles("size"))

    @classmethod
    def list_released(cls, numbers: Numbers) -> list[str]:
        """List the numbers that are held by default, and are not neutral."""
        return [name for name, role in cls.roles("held").items() if numbers[name] != role.neutral]

    @classmethod
    def plainer(cls, numbers: Numbers) -> dict[str, Numbers]:
        """Plain laws of an effect with these numbers, by kind: itself with what is held by default, and special cases."""
        neutral = {name: cls.neutral()[name] for name in cls.list_released(numbers)}
        itself = {cls.kind: {**numbers, **neutral}} if neutral else {}
        return itself | {kind: reduced(numbers) for kind, reduced in cls.special_cases.items()}

    @classmethod
    def directions(cls) -> Sequence[Numbers]:
        """Combinations of sizes that are fitted, each with factors of the sizes; one for each size unless overridden."""
        return [{name: 1.0} for name in cls.sizes()]

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        """True if fitted numbers may be those of such an effect: each size is above its minimum."""
        return all(
            declaration.minimum is None or numbers[field.name] > declaration.minimum
            for field, declaration in parameters(cls)
            if field.name in cls.sizes()
        )

    @classmethod
    def find_fault(cls, numbers: Mapping[str, Any], period: float) -> str:
        """Say what is wrong with a study's `numbers`, of which each is in its range, and what would be right.

        Args:
            numbers: of this effect, by config key.
            period: sampling period, s.

        Returns:
            One line, or "" if nothing is wrong.
        """
        return ""

    @classmethod
    def suits(cls, transmission: Any) -> bool:
        """True if it may stand beside a transmission law (None on a rigid drive)."""
        return True


class SideEffect(AbstractEffect):
    """An effect on the motor or the load; `side` says on which."""

    places = ("motor", "load")
    side: str = eqx.field(static=True, kw_only=True)

    @property
    def place(self) -> str:
        return self.side


class TransmissionEffect(AbstractEffect):
    """An effect in the gear."""

    places = ("transmission",)

    @classmethod
    def suits(cls, transmission):
        return transmission is not None


class ActuatorEffect(AbstractEffect):
    """An effect on the input torque. Several act one after the other, in the order of the config.

    Its :meth:`resist` torque is subtracted on the motor.

    Attributes:
        rank: place in the order of effects that a config does not list.
        input_unit: unit of the input, if the effect determines it; otherwise "".
    """

    places = ("actuator",)
    rank = 0
    input_unit = ""


class EncoderEffect(AbstractEffect):
    """An effect on the readings of an encoder.

    Attributes:
        encoder: side of the encoder, "motor" or "load"; on a rigid drive it is always the motor's.
    """

    places = ("encoder",)
    encoder = "load"
    in_log = "its readings have it already"


class _Effects(Registry):
    """Effects by full name; a class has one name for each place where it may act."""

    def add(self, cls: type) -> type:
        for place in cls.places:
            self._members[f"{place}.{cls.kind}"] = cls
        return cls


def make_effect(name: str, **numbers: float) -> AbstractEffect:
    """Make an effect from its full name and its numbers. Raises `KeyError` for an unknown name.

    Example:
        >>> make_effect("load.coulomb_friction", torque=0.5).name
        'load.coulomb_friction'
    """
    cls: Any = EFFECTS[name]
    return cls(side=name.partition(".")[0], **numbers) if issubclass(cls, SideEffect) else cls(**numbers)


def correction_of(number: str, side: str) -> tuple[str, str]:
    """Return the name of the effect that is the error of the drive's `inertia` or `viscous` friction on a side, and the name
    of its size."""
    name = next(name for name, cls in EFFECTS.items() if cls.corrects == number and name.startswith(f"{side}."))
    return name, EFFECTS[name].sizes()[0]


def _check_effect(name: str, cls: Any) -> None:
    """Check an effect that an installed package adds. Raises an exception whose text says in one line what is wrong."""
    if not (isinstance(cls, type) and issubclass(cls, AbstractEffect)):
        raise TypeError("should be a class derived from AbstractEffect")
    place, _, kind = name.partition(".")
    if kind != cls.kind or place not in cls.places:
        names = [f"{class_place}.{cls.kind}" for class_place in cls.places]
        raise ValueError(f"its class acts as {' or '.join(names) or 'nothing'}; the entry should have that name")
    if not set(cls.places) <= set(PLACES) or not re.fullmatch(r"[a-z][a-z0-9_]*", kind):
        raise ValueError(f"places should be among {', '.join(PLACES)}, and kind a lower-case word")
    if issubclass(cls, SideEffect) != (place in ("motor", "load")):
        raise TypeError("effects on motor or load, and no others, should be derived from SideEffect")
    for hook, base_method in inspect.getmembers(AbstractEffect, inspect.isfunction):
        expected, actual = (list(inspect.signature(method).parameters) for method in (base_method, getattr(cls, hook)))
        if not hook.startswith("_") and actual != expected:
            raise TypeError(f"{hook} should take ({', '.join(expected)}), not ({', '.join(actual)})")
    _check_numbers(cls)
    if neutral := cls.neutral():
        side = {"side": place} if issubclass(cls, SideEffect) else {}
        _check_neutral(cls(**side, **neutral))  # type: ignore[arg-type]


def _check_numbers(cls: type[AbstractEffect]) -> None:
    for field, declaration in parameters(cls):
        if not isinstance(declaration, Parameter) or not isinstance(declaration.unit, str):
            raise TypeError(f"{field.name} should be declared with a unit")
        check_text(f"{field.name}: unit", declaration.unit)
        check_text(f"{field.name}: description", declaration.doc)
    roles = [declaration.role for _, declaration in parameters(cls)]
    kinds = [role.kind for role in roles if role is not None]
    if kinds and len(kinds) < len(roles):
        raise TypeError("either all numbers or none should have a role (size, angle, harmonic, frequency, shape, held)")
    if kinds.count("angle") > 1 or ("angle" in kinds and kinds.count("size") != 1):
        raise TypeError("an angle should stand beside one size")
    if cls.corrects not in (None, "inertia", "viscous") or (cls.corrects and kinds != ["size"]):
        raise TypeError("corrects should be 'inertia' or 'viscous', of an effect with one size")


def _check_neutral(effect: AbstractEffect) -> None:
    """Check that an effect with neutral numbers does nothing, at a few motions."""
    state: Any = effect.init()
    for time, position, velocity in ((0.0, 0.3, 2.0), (0.1, -1.7, -0.5), (0.2, 4.0, 0.0)):
        motion = Motion(*map(np.float64, (time, position, velocity, 0.7)))
        state = effect.advance(state, motion, 1e-3)
        state, first, then, switch = effect.receive(state, motion.position, 1e-3)
        deviations = {
            "receive": then + (first - then) * switch / 1e-3 - motion.position,
            "resist": effect.resist(state, motion),
            "dry_friction": effect.dry_friction(state, motion),
            "gear_friction": effect.gear_friction(state, motion.torque),
            "added_inertia": effect.added_inertia(),
            "read": effect.read(motion.position, motion.velocity) - motion.position,
            "transmission_error": effect.transmission_error(state, motion.position),
            "deflect": effect.deflect(state, motion.position) - motion.position,
            "transmit": effect.transmit(state, motion.position, motion.velocity),
            "actuate": effect.actuate(state, motion.position, 1e-3)[1] - motion.position,
        }
        for hook, deviation in deviations.items():
            if not abs(float(deviation)) < _ROUNDING:
                raise ValueError(
                    f"its neutral numbers {effect.neutral()} are not neutral: {hook} adds {float(deviation):.3g}"
                )


_ROUNDING = 1e-6
"""Largest torque or angle of a neutral effect at motions of size 1: rounding in float32."""

EFFECTS = _Effects("jaxbl.effects", _check_effect)
"""Effects by full name, those of installed packages included."""
