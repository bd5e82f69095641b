"""Certificates: proven error bounds of super-twisting gains, for all noise and disturbances within bounds."""

# pandas' own annotations are wider than what its methods return
# pyright: reportGeneralTypeIssues=false

import math
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbl.config import SideCertificateTable
from jaxbl.errors import InputError, NoResult
from jaxbl.files import json_with_checksum, read_json, to_jsonable, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import convergence_time_worst, peak_ratio
from jaxbl.observer.super_twisting import DISCRETISATIONS
from jaxbl.sweeps.elementwise import call_in_float64

from .adversary import search_violations
from .gain_search import GainSearch
from .invariant_set import ErrorSystem, Proof, prove

_SETTLED_RATIO = 1.05
"""Default accuracy over the final accuracy: a bound that is slightly wider than the final one holds much earlier."""
_CURVE_POINTS = 200
"""Points of a certificate's curve, the bound over time."""
_NOISE_RMS_FACTOR = 5.0
"""Default bound of the encoder noise over its rms."""


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
) -> JsonObject:
    """Prove a velocity accuracy and a reaching time for gains, and look for a counterexample by adversarial runs.

    Source: sets that the sampled error system cannot leave (:mod:`.invariant_set`, docs/theory_appendix.md).

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
        runs: number of adversarial runs.
        seed: random seed of these runs.

    Returns:
        A dictionary:

        - `certified`, and `why_none` if that is false; `gains` and `assumptions`;
        - `accuracy` (rad/s), which holds at all samples from `reaching_time` (s) on;
        - `final_accuracy` (rad/s), which holds in the end;
        - `reaching_time_continuous` (s): the longest reaching time in continuous time without noise;
        - `resolution` (rad/s) of the proof, and `curve`: the bound (rad/s) over time (s);
        - `search`: the numbers of `runs`, `explored` states and `violations`; the `worst` error that was found (rad/s), the
          `ratio` of `final_accuracy` to it, and the longest `reaching_time` that was found (s);
        - `limits`: each limit that was `asked` for, and whether it is `met`.

    Raises:
        InputError: a number is out of its range.
        NoResult: nothing can be proven for these gains.

    Example:
        >>> bounds = {"noise": 5e-5, "f_plus": 5.0, "period": 1e-3, "velocity_error": 0.1}
        >>> certify(2.2, 9.2, **bounds, runs=1)["certified"]
        True
    """
    position_error = noise if position_error is None else position_error
    question = Question(
        lambda_, alpha, discretisation, period, f_plus, noise, velocity_error, position_error, acceleration, accuracy,
        reaching_time,
    )  # fmt: skip
    system, start, proof, bounds, proven_accuracy, proven_time, limits = _prove(question)
    speed = f_plus * period
    adversary = search_violations(system, *start, proof, proven_accuracy / speed, runs, seed)
    numbers = (lambda_, alpha, f_plus, start[0] * speed * period, velocity_error)
    samples = np.unique(np.linspace(0, len(bounds) - 1, _CURVE_POINTS).astype(int))
    refusal = None
    if adversary.violations:
        share = f"{adversary.violations} of {adversary.runs}"
        refusal = f"refused: {share} adversarial runs exceed the proven bound; please report this as an error of jaxbl"
    return to_jsonable({
        "certified": refusal is None,
        "why_none": refusal,
        "gains": {"lambda": lambda_, "alpha": alpha},
        "assumptions": question.list_assumptions(),
        "accuracy": proven_accuracy,
        "reaching_time": proven_time,
        "final_accuracy": bounds[-1],
        "reaching_time_continuous": call_in_float64(convergence_time_worst, *numbers),
        "resolution": proof.row * speed,
        "curve": {"time": samples * period, "bound": bounds[samples]},
        "search": {
            "runs": adversary.runs,
            "explored": adversary.explored,
            "worst": adversary.worst * speed,
            "ratio": proof.bounds[-1] / adversary.worst if adversary.worst else None,
            "reaching_time": (adversary.latest + 1) * period,
            "violations": adversary.violations,
        },
        "limits": limits,
    })  # fmt: skip


class Question(NamedTuple):
    """Question that a certificate answers: arguments of :func:`certify` in SI units."""

    lambda_: float
    alpha: float
    discretisation: str
    period: float
    f_plus: float
    noise: float
    velocity_error: float
    position_error: float
    acceleration: float
    accuracy: float | None
    reaching_time: float | None

    def list_assumptions(self) -> JsonObject:
        """Return the table `assumptions` of a certificate."""
        assumptions = self._asdict()
        for name in ("lambda_", "alpha", "accuracy", "reaching_time"):
            del assumptions[name]
        if self.discretisation == "implicit":
            del assumptions["acceleration"]
        return assumptions


class _ScaledProof(NamedTuple):
    """A proof, scaled back to SI units.

    Attributes:
        system: the normalised error system.
        start: largest starting errors of position and velocity, in units of f⁺ T² and f⁺ T.
        proof: the proof in these units.
        bounds: bounds of the velocity error by sample, rad/s.
        accuracy: the bound that is certified, rad/s.
        reaching_time: from which `accuracy` holds, s.
        limits: each limit that was asked for, and whether it is met. The reaching time is that of the accuracy asked for,
            if this is met.
    """

    system: ErrorSystem
    start: tuple[float, float]
    proof: Proof
    bounds: np.ndarray
    accuracy: float
    reaching_time: float
    limits: JsonObject


def _prove(question: Question) -> _ScaledProof:
    lambda_, alpha, discretisation, period, f_plus, noise, velocity_error, position_error, acceleration, accuracy, _ = (
        question
    )
    if discretisation not in DISCRETISATIONS:
        schemes = ", ".join(DISCRETISATIONS)
        raise InputError(f"discretisation: '{discretisation}' is unknown; it should be one of {schemes}")
    for name, value in question._asdict().items():
        if name in ("discretisation", "reaching_time") or value is None or (0.0 < value < math.inf):
            continue
        is_divisor = name in ("f_plus", "period", "accuracy")
        if is_divisor or value != 0.0:
            sign = ">" if is_divisor else ">="
            raise InputError(f"{name.rstrip('_')}: a certificate needs a finite number {sign} 0, not {value}")
    ratio = float(call_in_float64(peak_ratio, lambda_, alpha, f_plus))
    if alpha <= f_plus:
        raise NoResult(f"alpha = {alpha:.4g} rad/s² does not exceed f⁺ = {f_plus:.4g} rad/s²: the error need not shrink")
    if not ratio < 1.0:
        raise NoResult(
            f"the exact condition fails: at f⁺ = {f_plus:.4g} rad/s² each peak of the velocity error can be {ratio:.3g} "
            "times the one before"
        )
    speed, length = f_plus * period, f_plus * period * period
    implicit = discretisation == "implicit"
    push = 0.0 if implicit else acceleration / f_plus
    system = ErrorSystem(implicit, lambda_ / math.sqrt(f_plus), alpha / f_plus, noise / length, push)
    start = position_error / length, velocity_error / speed
    proof = prove(system, *start)
    bounds = proof.bounds * speed
    # compared in rad/s: in units of f⁺ T rounding could put the accuracy below the last bound
    proven_accuracy = _SETTLED_RATIO * float(bounds[-1]) if accuracy is None or accuracy < bounds[-1] else accuracy
    proven_time = int((bounds <= proven_accuracy).argmax()) * period
    asked = {"accuracy": (accuracy, bounds[-1]), "reaching_time": (question.reaching_time, proven_time)}
    limits = {
        name: {"asked": limit, "met": bool(proven <= limit)} for name, (limit, proven) in asked.items() if limit is not None
    }
    return _ScaledProof(system, start, proof, bounds, proven_accuracy, proven_time, limits)


def choose_question(search: GainSearch, side: str) -> Question:
    """Return the question for the best gains of a side: assumptions and limits of `[tune.certificate]`, else the study's
    assumptions and its pilot's."""
    config, pilot, best = search.scenarios.config, search.pilot[side], search.best_candidate(side)
    table = search.table.certificate
    assert table is not None
    side_table = getattr(table, side) or SideCertificateTable()
    encoders = config.encoders.build()
    rms = float(encoders.noise_of(side, config.drive.build().ratio(side)))
    count = encoders.resolution_of(side)
    stated = side_table.model_dump(exclude_none=True)
    f_plus = stated.get("f_plus", max(search.f_plus[side], best["f_plus"], pilot["start"]))
    noise = stated.get("noise", 0.5 * float(count) + _NOISE_RMS_FACTOR * rms)
    return Question(
        float(best["lambda"]),
        float(best["alpha"]),
        config.observer.discretisation,
        config.run.sample_period,
        f_plus,
        noise,
        abs(pilot["velocity_error"]),
        max(abs(pilot["position_error"]), noise),
        pilot["largest_acceleration"] + f_plus,
        None,
        None,
    )._replace(**stated)


_MOST_ATTEMPTS = 50
"""Gains of a side that are tried, best first, until some meet the limits."""


def choose_certified_gains(search: GainSearch) -> dict[str, int]:
    """Mark the best gains as not feasible until the best ones left meet the limits of `[tune.certificate]`.

    Returns the number of gains that were passed over on each side. If none meet the limits, all stay feasible.
    """
    passed_over = {}
    for side in search.sides:
        frame = search.candidates[side]
        feasible_before, passed_over[side] = frame["feasible"].copy(), 0
        pair_count = frame[feasible_before].groupby(["lambda", "alpha"]).ngroups
        for attempt in range(min(pair_count, _MOST_ATTEMPTS)):
            question = choose_question(search, side)
            if question.accuracy is None and question.reaching_time is None:
                break
            with suppress(NoResult):
                if all(limit["met"] for limit in _prove(question).limits.values()):
                    passed_over[side] = attempt
                    break
            frame.loc[(frame["lambda"] == question.lambda_) & (frame["alpha"] == question.alpha), "feasible"] = False
        else:
            frame["feasible"] = feasible_before
    return passed_over


def certify_best_gains(search: GainSearch, path: Path | None) -> JsonObject:
    """Certify the best gains of each side. Certificates are stored in a file, and read from it if nothing has changed.

    Returns certificates by side, as of :func:`certify`. If nothing can be proven, `certified` is false and `why_none` set.
    """
    table = search.table.certificate
    assert table is not None
    runs: JsonObject = {"runs": table.runs}
    arguments_by_side = {side: choose_question(search, side)._asdict() | runs for side in search.sides}
    key = {"version": version("jaxbl"), "asked": to_jsonable(arguments_by_side)}
    if path is not None:
        with suppress(FileNotFoundError, InputError):
            stored = read_json(path)
            if {name: stored.get(name) for name in key} == key:
                return stored["found"]
    certificates = {}
    for side, arguments in arguments_by_side.items():
        try:
            certificates[side] = certify(**arguments)
        except NoResult as error:
            certificates[side] = {"certified": False, "why_none": str(error)}
    if path is not None:
        write_atomic(path, json_with_checksum(key | {"found": certificates}))
    return certificates
