"""Certificates: what gains of a super-twisting observer provably hold, whatever noise and disturbance do within bounds."""

# pandas' own annotations are wider than what its methods return
# pyright: reportGeneralTypeIssues=false

import math
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import SideCertificateTable
from jaxbl.errors import InputError, NoResult
from jaxbl.files import json_with_checksum, read_json, to_jsonable, write_atomic
from jaxbl.observer.conditions import convergence_time_worst, peak_ratio
from jaxbl.observer.super_twisting import DISCRETISATIONS

from .adversary import search
from .gain_search import GainSearch
from .invariant_set import ErrorSystem, Proof, prove

SETTLED = 1.05
"""Velocity bound that a reaching time leads to, over the bound of all later times; where no other one is asked for."""
_POINTS = 200
"""Of the curve that is kept of a bound over time."""
_RMS = 5.0
"""Rms values of encoder noise that count as its bound, where none is given."""


def certify(
    lambda_: float,
    alpha: float,
    *,
    noise: float,
    f_plus: float,
    period: float,
    velocity_error: float,
    position_error: float | None = None,
    discretisation: str = "implicit",
    acceleration: float = 0.0,
    accuracy: float | None = None,
    reaching_time: float | None = None,
    runs: int = 1_000_000,
    seed: int = 0,
) -> dict[str, Any]:
    """Prove a velocity accuracy and a reaching time for gains, and look for a counterexample by adversarial runs.

    Source: sets that the sampled error system cannot leave (:mod:`.invariant_set`, docs/theory.md).

    Args:
        lambda_: gain, rad^0.5/s.
        alpha: gain, rad/s^2.
        noise: bound of the reading's error, with rounding to counts, rad.
        f_plus: bound of the acceleration that the nominal model lacks, rad/s^2.
        period: sampling period, s.
        velocity_error: largest velocity error at the first sample, rad/s.
        position_error: largest position error there, rad; None: `noise`.
        discretisation: as the key of [observer].
        acceleration: bound of the nominal acceleration, rad/s^2; for the explicit form, whose prediction of the position
            leaves it out.
        accuracy: velocity error that is asked for, rad/s.
        reaching_time: time after which it is asked for, s.
        runs: adversarial runs.
        seed: of these runs.

    Returns:
        Plain data: `gains`; `assumptions`; `accuracy` (rad/s), which holds at all samples from `reaching_time` (s) on, and
        `final_accuracy`, which holds in the end; `reaching_time_continuous` (s), the longest without noise in continuous
        time; `resolution` (rad/s) of the proof, and its `curve`, the bound (rad/s) over time (s); `search` with the numbers
        of `runs`, `explored` states and `violations`, the `worst` error found (rad/s), the `ratio` of `final_accuracy` to
        it, and the largest `reaching_time` found (s); `limits` that were asked for, and whether each is `met`; `certified`,
        and `why_none` if that is false.

    Raises:
        InputError: a number that makes no sense.
        NoResult: nothing is proven for these gains, and why.
    """
    inputs = Inputs(discretisation, period, f_plus, noise, velocity_error, position_error, acceleration)
    proven = _prove(lambda_, alpha, inputs, accuracy)
    system, start, proof, bounds, settled, reached = proven
    speed, final = f_plus * period, float(bounds[-1])
    found = search(system, *start, proof, settled / speed, runs, seed)
    with jax.enable_x64(True):
        numbers = (lambda_, alpha, f_plus, start[0] * speed * period, velocity_error)
        continuous = float(convergence_time_worst(*(jnp.asarray(float(x)) for x in numbers)))
    kept = np.unique(np.linspace(0, len(bounds) - 1, _POINTS).astype(int))
    why = None
    if found.violations:
        why = (
            f"refused: {found.violations} of {found.runs} adversarial runs went above the bound that was proven; please "
            "report this as an error of jaxbl"
        )
    return to_jsonable({
        "certified": why is None,
        "why_none": why,
        "gains": {"lambda": lambda_, "alpha": alpha},
        "assumptions": inputs.data(),
        "accuracy": settled,
        "reaching_time": reached * period,
        "final_accuracy": final,
        "reaching_time_continuous": continuous,
        "resolution": proof.row * speed,
        "curve": {"time": (kept * period).tolist(), "bound": bounds[kept].tolist()},
        "search": {
            "runs": found.runs,
            "explored": found.explored,
            "worst": found.worst * speed,
            "ratio": proof.bounds[-1] / found.worst if found.worst else None,
            "reaching_time": (found.latest + 1) * period,
            "violations": found.violations,
        },
        "limits": _limits(inputs, proven, accuracy, reaching_time),
    })  # fmt: skip


class Inputs(NamedTuple):
    """Assumptions of a certificate, in SI units, as the arguments of :func:`certify`."""

    discretisation: str
    period: float
    f_plus: float
    noise: float
    velocity_error: float
    position_error: float | None = None
    acceleration: float = 0.0

    @property
    def start(self) -> float:
        """Largest position error at the first sample, rad."""
        return self.noise if self.position_error is None else self.position_error

    def data(self) -> dict[str, Any]:
        """What a certificate says of them."""
        found = self._asdict() | {"position_error": self.start}
        if self.discretisation == "implicit":
            found.pop("acceleration")
        return found


class _Proven(NamedTuple):
    """A proof: the system, its starting errors and its sets in units of f⁺ T² and f⁺ T; bounds by sample and the one that
    counts (rad/s), and the sample from which the latter holds."""

    system: ErrorSystem
    start: tuple[float, float]
    proof: Proof
    bounds: np.ndarray
    settled: float
    reached: int


def _prove(lambda_: float, alpha: float, inputs: Inputs, accuracy: float | None) -> _Proven:
    f_plus, period = inputs.f_plus, inputs.period
    if inputs.discretisation not in DISCRETISATIONS:
        raise InputError(
            f"discretisation: '{inputs.discretisation}' is none; it should be one of {', '.join(DISCRETISATIONS)}"
        )
    numbers = inputs._asdict() | {
        "lambda": lambda_, "alpha": alpha, "position_error": inputs.start, "accuracy": accuracy,
    }  # fmt: skip
    for name in ("lambda", "alpha", "noise", "velocity_error", "position_error", "acceleration"):
        value = numbers[name]
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{name}: a certificate needs a finite number >= 0, not {value}")
    for name in ("f_plus", "period", "accuracy"):
        value = numbers[name]
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name}: a certificate needs a finite number > 0, not {value}")
    with jax.enable_x64(True):
        ratio = float(peak_ratio(*(jnp.asarray(float(x)) for x in (lambda_, alpha, f_plus))))
    if alpha <= f_plus:
        raise NoResult(f"alpha = {alpha:.4g} rad/s² does not exceed f⁺ = {f_plus:.4g} rad/s²: the error need not shrink")
    if not ratio < 1.0:
        raise NoResult(
            f"the exact condition fails: at f⁺ = {f_plus:.4g} rad/s² each peak of the velocity error can be {ratio:.3g} "
            "times the one before"
        )
    speed, length = f_plus * period, f_plus * period * period
    implicit = inputs.discretisation == "implicit"
    push = 0.0 if implicit else inputs.acceleration / f_plus
    system = ErrorSystem(implicit, lambda_ / math.sqrt(f_plus), alpha / f_plus, inputs.noise / length, push)
    start = inputs.start / length, inputs.velocity_error / speed
    proof = prove(system, *start)
    bounds = proof.bounds * speed
    # in the units of what is asked for: a quotient could come out below the last bound, which none then keeps
    settled = SETTLED * float(bounds[-1]) if accuracy is None or accuracy < bounds[-1] else accuracy
    return _Proven(system, start, proof, bounds, settled, int((bounds <= settled).argmax()))


def _limits(inputs: Inputs, proven: _Proven, accuracy: float | None, reaching_time: float | None) -> dict[str, Any]:
    """What was asked for, and whether it is met; the time is that to the accuracy asked for, if that is met."""
    found: dict[str, Any] = {}
    if accuracy is not None:
        found["accuracy"] = {"asked": accuracy, "met": bool(proven.bounds[-1] <= accuracy)}
    if reaching_time is not None:
        found["reaching_time"] = {"asked": reaching_time, "met": proven.reached * inputs.period <= reaching_time}
    return found


def inputs_of(search: GainSearch, side: str, f_plus: float) -> Inputs:
    """Assumptions for a side of a study that is tuned: those of `[tune.certificate]`, else what the study and its pilot run
    have; `f_plus` is the largest along the runs, rad/s^2."""
    config, pilot, own = search.scenarios.config, search.pilot[side], _asked(search, side)
    encoders = config.build().encoders
    rms = float(encoders.noise_of(side, config.drive.gear_ratio if side == "load" else 1.0))
    count = encoders.motor_resolution if side == "motor" else encoders.load_resolution
    f_plus = max(search.f_plus[side], f_plus) if own.f_plus is None else own.f_plus
    noise = 0.5 * float(count) + _RMS * rms if own.noise is None else own.noise
    velocity, position = abs(pilot["velocity_error"]), max(abs(pilot["position_error"]), noise)
    acceleration = pilot["largest_acceleration"] + f_plus if own.acceleration is None else own.acceleration
    return Inputs(
        config.observer.discretisation,
        config.run.sample_period,
        f_plus,
        noise,
        velocity if own.velocity_error is None else own.velocity_error,
        position if own.position_error is None else own.position_error,
        acceleration,
    )


def _asked(search: GainSearch, side: str) -> SideCertificateTable:
    table = search.table.certificate
    assert table is not None
    return getattr(table, side) or SideCertificateTable()


_MOST_TRIED = 50
"""Gains of a side that are tried one after the other, best first, where limits are asked for."""


def choose_certified(search: GainSearch) -> dict[str, int]:
    """Take gains out of the feasible ones that do not meet the limits of `[tune.certificate]`, until the best ones do.

    Returns how many were taken out on each side; none where no gains tried meet the limits.
    """
    out = {}
    for side in search.sides:
        own, frame = _asked(search, side), search.candidates[side]
        before, out[side] = frame["feasible"].copy(), 0
        if own.accuracy is None and own.reaching_time is None:
            continue
        for tried in range(_MOST_TRIED):
            if not frame["feasible"].any():
                break
            best = search.best_candidate(side)
            inputs = inputs_of(search, side, best["f_plus"])
            with suppress(NoResult):
                proven = _prove(best["lambda"], best["alpha"], inputs, own.accuracy)
                if all(found["met"] for found in _limits(inputs, proven, own.accuracy, own.reaching_time).values()):
                    out[side] = tried
                    break
            frame.loc[(frame["lambda"] == best["lambda"]) & (frame["alpha"] == best["alpha"]), "feasible"] = False
        else:
            frame["feasible"] = before
        if not frame["feasible"].any():
            frame["feasible"] = before
    return out


def certificates(search: GainSearch, path: Path | None) -> dict[str, Any]:
    """Certificates of the best gains of each side, as plain data by side; kept in a file and read again.

    A side of which nothing is proven has `certified` false and `why_none`.
    """
    table = search.table.certificate
    assert table is not None
    asked = {}
    for side in search.sides:
        best, own = search.best_candidate(side), _asked(search, side)
        asked[side] = {"lambda_": float(best["lambda"]), "alpha": float(best["alpha"]), "runs": table.runs}
        asked[side] |= inputs_of(search, side, best["f_plus"])._asdict()
        asked[side] |= {"accuracy": own.accuracy, "reaching_time": own.reaching_time}
    key = {"version": version("jaxbl"), "asked": to_jsonable(asked)}
    if path is not None:
        with suppress(FileNotFoundError, InputError):
            kept = read_json(path)
            if {name: kept.get(name) for name in key} == key:
                return kept["found"]
    found = {}
    for side, given in asked.items():
        try:
            found[side] = certify(**given)
        except NoResult as error:
            found[side] = {"certified": False, "why_none": str(error)}
    if path is not None:
        write_atomic(path, json_with_checksum(key | {"found": found}))
    return found
