"""What an effect is, and what it says of itself.

An effect is a module that overrides the hooks that concern it; the plant asks every effect of its tuple at every step,
and the neutral answers (the Python number 0.0, or the argument itself) cost nothing after compilation. Its numbers say
what part they play (:class:`Role`), and with a few class attributes that is all that a config, a sweep, an
identification, a diagnosis, a report and the reference ask for. Sign convention: `resist` torques are subtracted on
their side, J dv/dt = ... - resist, so that a positive number always opposes a positive drive torque.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np

from jaxbl.registry import Registry, check_text

from ..mujoco_parts import MujocoParts, Said, unsaid
from ..parameters import Parameter, parameter, parameters

Value = Any  # a number or an array of one: hooks are duck-typed, neutral ones answer the Python number 0.0
Numbers = dict[str, float]
"""Numbers of one effect, by name."""
PLACES = ("motor", "load", "transmission", "actuator", "encoder")


class Motion(NamedTuple):
    """What the torque of an effect may depend on: time in s, position in rad, velocity in rad/s.

    Of its side (of an effect of the actuator, the motor); for an effect in the gear, the elastic deflection and its rate (to
    `advance`, in the middle of the step). `torque` is the input that acts, N m, in :meth:`AbstractEffect.resist` and
    :meth:`AbstractEffect.dry_friction` of an effect on the motor; elsewhere 0.
    """

    time: Value
    position: Value
    velocity: Value
    torque: Value = 0.0


class Scales(NamedTuple):
    """How large things are on a log, as an effect at one place sees them; trial values are chosen by it.

    Attributes:
        torque: largest input, N m.
        period: of the samples, s.
        duration: of all samples, s.
        twist: rms of z = theta_e - N_0 theta_s, rad; 0 on a rigid drive.
        largest_twist: rad.
        speed: rms of the effect's side (the motor's for gear and actuator), rad/s.
        spread: standard deviation of that side's position, rad.
        travel: range of that side's position, rad; for an effect in the gear, the load's.
        ratio: motor turns for one load turn; 1 on a rigid drive.
        harmonics: periods a turn of the waves over position that the model has on the side.
        frequencies: at which a torque on the side would explain most of what the model leaves, Hz.
    """

    torque: float
    period: float
    duration: float
    twist: float
    largest_twist: float
    speed: float
    spread: float
    travel: float
    ratio: float = 1.0
    harmonics: tuple[float, ...] = ()
    frequencies: tuple[float, ...] = ()


class Role(NamedTuple):
    """The part that a number plays in its effect.

    Attributes:
        kind: `size`: the torque is proportional to it. `angle`: a phase in rad. `harmonic`: a number of periods a turn,
            which is chosen and not fitted. `frequency`: in Hz. `shape`: any other number, positive. `held`: one that is not
            sought: it stays neutral.
        neutral: its value where the effect does nothing.
        trials: the values to try on a log of given scales. Of a size: one, small enough for its torque to be linear.
        width: prior standard deviation: of an angle in rad, of a shape in its logarithm.
        sought: number of values that a harmonic was sought among; left out: the number of trials.
    """

    kind: Literal["size", "angle", "harmonic", "frequency", "shape", "held"]
    neutral: float
    trials: Callable[[Scales], Sequence[float]]
    width: float = 1.0
    trial_count: Callable[[Scales], int] | None = None


def size(unit: str, doc: str, *, trial: Callable[[Scales], float] = lambda log: 1.0, **limits: Any) -> Any:
    """Declare a number that the torque is proportional to. Arguments as of :func:`jaxbl.drive.parameters.parameter`."""
    return parameter(unit, doc, role=Role("size", 0.0, lambda log: (trial(log),)), **limits)


def angle(doc: str) -> Any:
    """Declare a phase in rad, 0 unless given. Its prior is that of any angle: standard deviation pi / sqrt(3)."""
    return parameter("rad", doc, default=0.0, role=Role("angle", 0.0, lambda log: (0.0,), 1.8))


def harmonic(
    doc: str,
    trials: Callable[[Scales], Sequence[float]],
    *,
    sought: Callable[[Scales], int] | None = None,
    **limits: Any,
) -> Any:
    """Declare a number of periods a turn."""
    return parameter("1/turn", doc, above=0.0, role=Role("harmonic", 1.0, trials, trial_count=sought), **limits)


def frequency(doc: str) -> Any:
    """Declare a frequency in Hz; those are tried at which a torque on the effect's side explains most."""
    return parameter("Hz", doc, minimum=0.0, role=Role("frequency", 1.0, lambda log: log.frequencies))


def shape(unit: str, doc: str, trials: Callable[[Scales], Sequence[float]], *, neutral: float = 1.0, **limits: Any) -> Any:
    """Declare a positive number that the torque is not proportional to: a speed, a gap, a time constant."""
    return parameter(unit, doc, role=Role("shape", neutral, trials), **limits)


def held(unit: str, doc: str, neutral: float, **limits: Any) -> Any:
    """Declare a number for simulations, `neutral` unless given. A diagnosis leaves it there, an identification too unless it
    is given or asked for."""
    return parameter(unit, doc, default=neutral, role=Role("held", neutral, lambda log: (neutral,)), **limits)


def table(unit: str, doc: str) -> Any:
    """Declare a list of numbers, empty unless given. No axis and no fit changes them."""
    return parameter(unit, doc, default=(), fixed=True)


class AbstractEffect(eqx.Module):
    """Base of all effects; every hook has a neutral default.

    A hook's `state` is the effect's own: what :meth:`init` gives, moved on by :meth:`actuate` and :meth:`advance`.

    Attributes:
        kind: its name without the place.
        places: where it may act: motor, load, transmission, actuator, encoder.
        velocity_dependent: whether a hook looks at a velocity; it is then evaluated twice a step (predictor and
            corrector), which keeps the integrator's second order.
        input_alone: whether its own state is what was commanded, whatever its numbers and the motion: it is then known.
        follows: whether its own state follows, by its numbers, from the input or from the motion as it is measured: within
            a log it is then as known as these.
        in_time: whether it depends on the time since a log began.
        corrects: the drive's number that it is the error of: `inertia` or `viscous`.
        exclusive: of effects with the same word here, a place has one.
        special_cases: simpler kinds at the same place that it contains, and their numbers from its own.
    """

    kind: ClassVar[str]
    places: ClassVar[tuple[str, ...]]
    velocity_dependent: ClassVar[bool] = False
    state_from_input: ClassVar[bool] = False
    state_from_measurement: ClassVar[bool] = False
    in_time: ClassVar[bool] = False
    corrects: ClassVar[str | None] = None
    exclusive: ClassVar[str | None] = None
    special_cases: ClassVar[Mapping[str, Callable[[Numbers], Numbers]]] = {}

    @property
    def place(self) -> str:
        """Where it acts."""
        return self.places[0]

    @property
    def name(self) -> str:
        """Full name, e.g. `load.coulomb_friction`."""
        return f"{self.place}.{self.kind}"

    def init(self) -> Any:
        """The effect's own state at t = 0: a tuple of numbers (or of tuples of them), each a scalar array."""
        return ()

    def settled(self, torque: Value) -> Any:
        """The own state after a commanded torque (N m) that has lasted; at t = 0 unless the effect says otherwise."""
        return type(self).init(self)

    def set_in_motion(self, state: Any, velocity: Value) -> Any:
        """The own state :meth:`init` on a side that moves (rad/s) when a log begins, as far as that says anything."""
        return state

    def advance(self, state: Any, motion: Motion, step: Value) -> Any:
        """The own state after `step` seconds at a steady velocity. The plant calls it for both halves of a step."""
        return state

    def receive(self, state: Any, torque: Value, period: Value) -> tuple[Any, Value, Value, Value]:
        """What arrives of an input (N m) that is commanded for a sample of `period` seconds, before :meth:`actuate`: the own
        state, the torque that goes on at first, the one after it, and the time in s at which they change."""
        return state, torque, torque, 0.0

    def actuate(self, state: Any, torque: Value, step: Value) -> tuple[Any, Value]:
        """Turn the commanded torque (N m) into the one that acts over the next `step` seconds."""
        return state, torque

    def transmission_error(self, state: Any, load_position: Value) -> Value:
        """Kinematic error in rad on the motor side, added to z = theta_e - N_0 theta_s."""
        return 0.0

    def deflect(self, state: Any, z: Value) -> Value:
        """Elastic deflection in rad for a twist of z."""
        return z

    def free_play(self) -> Value:
        """Half of the free play in rad that :meth:`deflect` takes off a twist."""
        return 0.0

    def transmit(self, state: Any, deflection: Value, rate: Value) -> Value:
        """Torque in N m added to the transmitted one, from deflection (rad) and its rate (rad/s)."""
        return 0.0

    def resist(self, state: Any, motion: Motion) -> Value:
        """Torque in N m subtracted on the effect's side."""
        return 0.0

    def dry_friction(self, state: Any, motion: Motion) -> Value:
        """Level in N m of set-valued dry friction on the effect's side: it holds up to it, and opposes motion with it."""
        return 0.0

    def holds(self) -> Value:
        """Torque in N m up to which :meth:`resist` may hold a side that is not seen to move.

        Of a friction with a memory whose contacts bend by less than readings show: its own state is then not known.
        """
        return 0.0

    def gear_friction(self, state: Any, torque: Value) -> Value:
        """Level in N m of set-valued dry friction that a transmitted torque (N m) causes on the motor's side of the gear."""
        return 0.0

    def bent(self, torque: Value) -> Any:
        """The own state in which :meth:`resist` is nearest to a torque (N m), of an effect that :meth:`holds`."""
        return self.init()

    def read(self, position: Value, velocity: Value) -> Value:
        """What an encoder reads (rad) at a position (rad) and velocity (rad/s) of its side, before noise and counts."""
        return position

    def added_inertia(self) -> Value:
        """Inertia in kg m^2 added to the side's nominal one. It has no state: one that varies needs a torque as well."""
        return 0.0

    def to_mujoco(self, parts: MujocoParts, side: str) -> Said:
        """Add to the parts of a MuJoCo model what it has of the effect, and say how well it has it.

        The numbers are Python floats. `side` is where the effect acts; of one in the gear or the actuator, the motor.
        """
        return unsaid("its class does not say how")

    # what a diagnosis asks of the class

    @classmethod
    def roles(cls) -> dict[str, Role]:
        """The part that each number plays; empty for an effect that a diagnosis does not try."""
        found = {field.name: about.role for field, about in parameters(cls)}
        return {} if None in found.values() else found  # type: ignore[return-value]

    @classmethod
    def neutral(cls) -> Numbers:
        """Numbers with which the effect does nothing; empty where it is not known (:meth:`roles`)."""
        return {name: role.neutral for name, role in cls.roles().items()}

    @classmethod
    def sizes(cls) -> list[str]:
        """Numbers that its torque is proportional to."""
        return [name for name, role in cls.roles().items() if role.kind == "size"]

    @classmethod
    def directions(cls) -> Sequence[Numbers]:
        """Sets of sizes whose torques are fitted, each with a factor: one for each size unless the effect says otherwise."""
        return [{name: 1.0} for name in cls.sizes()]

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        """Whether numbers that were fitted are those of such an effect: sizes above their least value."""
        limits = {field.name: about.minimum for field, about in parameters(cls) if field.name in cls.sizes()}
        return all(least is None or numbers[name] > least for name, least in limits.items())

    @classmethod
    def find_fault(cls, numbers: Mapping[str, Any], period: float) -> str:
        """What is wrong with the numbers of a study whose samples are `period` seconds apart, beyond the range of each, and
        what would be right; "" if nothing is."""
        return ""

    @classmethod
    def suits(cls, transmission: Any) -> bool:
        """Whether it may stand beside a transmission law (None on a rigid drive)."""
        return True


class SideEffect(AbstractEffect):
    """An effect on the motor or on the load."""

    places: ClassVar[tuple[str, ...]] = ("motor", "load")
    side: str = eqx.field(static=True, kw_only=True)

    @property
    def place(self) -> str:
        return self.side


class TransmissionEffect(AbstractEffect):
    """An effect in the gear."""

    places: ClassVar[tuple[str, ...]] = ("transmission",)


class ActuatorEffect(AbstractEffect):
    """An effect on the input torque. Several act one after the other, in the order of the config; what it resists is taken
    off the motor's torque.

    Those that a config does not list are put in the order of `rank`.

    Attributes:
        rank: place in that order.
        input_unit: of the input, if the effect decides it; "" otherwise.
    """

    places: ClassVar[tuple[str, ...]] = ("actuator",)
    rank: ClassVar[int] = 0
    input_unit: ClassVar[str] = ""


class EncoderEffect(AbstractEffect):
    """An effect on what an encoder reads: the load's, or the motor's on a rigid drive, unless the class says otherwise.

    Attributes:
        encoder: whose.
        in_log: how a log without it is had, in words: models of logs have none.
    """

    places: ClassVar[tuple[str, ...]] = ("encoder",)
    encoder: ClassVar[str] = "load"
    in_log: ClassVar[str] = "its readings have it already"

    def to_mujoco(self, parts, side):
        return unsaid("the sensors of a model read true positions; it changes no motion")


class _Effects(Registry):
    """Effects by full name: a class stands there once for each place where it may act."""

    def add(self, cls: type) -> type:
        for place in cls.places:
            self._members[f"{place}.{cls.kind}"] = cls
        return cls


def make_effect(name: str, **numbers: float) -> AbstractEffect:
    """The effect of a full name (`load.coulomb_friction`) with given numbers. Raises `KeyError` for an unknown name."""
    cls: Any = EFFECTS[name]
    return cls(side=name.partition(".")[0], **numbers) if issubclass(cls, SideEffect) else cls(**numbers)


def correction_of(number: str, side: str) -> tuple[str, str]:
    """The effect that is the error of the drive's `inertia` or `viscous` friction on a side: its name, and its size."""
    name = next(name for name, cls in EFFECTS.items() if cls.corrects == number and name.startswith(f"{side}."))
    return name, EFFECTS[name].sizes()[0]


def _check_entry(name: str, found: Any) -> None:
    """Check what an installed package adds. Raises an exception whose text says in one line what is wrong."""
    if not (isinstance(found, type) and issubclass(found, AbstractEffect)):
        raise TypeError("should be a class derived from AbstractEffect")
    place, _, kind = name.partition(".")
    if kind != getattr(found, "kind", None) or place not in getattr(found, "places", ()):
        own = [f"{where}.{getattr(found, 'kind', '?')}" for where in getattr(found, "places", ())]
        raise ValueError(f"its class acts as {' or '.join(own) or 'nothing'}; the entry should have that name")
    if not set(found.places) <= set(PLACES) or not re.fullmatch(r"[a-z][a-z0-9_]*", kind):
        raise ValueError(f"places should be among {', '.join(PLACES)}, and kind a lower-case word")
    if issubclass(found, SideEffect) != (place in ("motor", "load")):
        raise TypeError("effects on motor or load, and no others, should be derived from SideEffect")
    for hook, of_base in inspect.getmembers(AbstractEffect, inspect.isfunction):
        expected, given = (list(inspect.signature(one).parameters) for one in (of_base, getattr(found, hook)))
        if not hook.startswith("_") and given != expected:
            raise TypeError(f"{hook} should take ({', '.join(expected)}), not ({', '.join(given)})")
    _check_numbers(found)
    if neutral := found.neutral():
        side = {"side": place} if issubclass(found, SideEffect) else {}
        _check_neutral(found(**side, **neutral))  # type: ignore[arg-type]


def _check_numbers(cls: type[AbstractEffect]) -> None:
    for field, about in parameters(cls):
        if not isinstance(about, Parameter) or not isinstance(about.unit, str):
            raise TypeError(f"{field.name} should be declared with a unit")
        check_text(f"{field.name}: unit", about.unit)
        check_text(f"{field.name}: description", about.doc)
    roles = [about.role for _, about in parameters(cls)]
    kinds = [role.kind for role in roles if role is not None]
    if kinds and len(kinds) < len(roles):
        raise TypeError("either all numbers or none should have a role (size, angle, harmonic, frequency, shape, held)")
    if kinds.count("angle") > 1 or ("angle" in kinds and kinds.count("size") != 1):
        raise TypeError("an angle should stand beside one size")
    if cls.corrects not in (None, "inertia", "viscous") or (cls.corrects and kinds != ["size"]):
        raise TypeError("corrects should be 'inertia' or 'viscous', of an effect with one size")


def _check_neutral(effect: AbstractEffect) -> None:
    """Check that at neutral numbers nothing is added, at a few motions."""
    state: Any = effect.init()
    for time, position, velocity in ((0.0, 0.3, 2.0), (0.1, -1.7, -0.5), (0.2, 4.0, 0.0)):
        motion = Motion(*map(np.float64, (time, position, velocity, 0.7)))
        state = effect.advance(state, motion, 1e-3)
        state, first, then, switch = effect.receive(state, motion.position, 1e-3)
        off = {
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
        for hook, value in off.items():
            if not abs(float(value)) < _NEUTRAL:
                raise ValueError(f"its neutral numbers {effect.neutral()} are not neutral: {hook} adds {float(value):.3g}")


_NEUTRAL = 1e-6
"""Largest torque or angle of a neutral effect at motions of size 1: rounding in float32."""

EFFECTS = _Effects("jaxbl.effects", _check_entry)
"""All effects by full name: the built-in ones and those of installed packages."""
