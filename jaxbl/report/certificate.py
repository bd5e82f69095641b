"""What a certificate of `jaxbl tune` says: sentences, a table, and `certificate.json` beside the gains."""

import math
from pathlib import Path

from jaxbl.files import write_json
from jaxbl.json_types import JsonObject
from jaxbl.result import ResultTable

ASSUMPTIONS = (
    "The acceleration of the shaft less the nominal one that the observer takes for a period (unknown torque over inertia, "
    "and what friction makes of the velocity error) stays within ±f_plus at all times; it may change at any time.",
    "The error of each reading, with its rounding to counts, stays within ±noise.",
    "The sampling period is fixed, and arithmetic is exact.",
    "At the first sample the errors are at most position_error and velocity_error.",
    "With the explicit discretisation the nominal acceleration stays within ±acceleration.",
    "It is about the velocity that the super-twisting observer estimates, not about the torque behind the low-pass.",
)
"""Of every certificate, in words; the numbers are beside them."""


def write_certificates(summary: JsonObject, folder: Path) -> None:
    """Write `certificate.json` of the sides of which something is proven, if there is one."""
    if proven := _proven(summary):
        data = {"title": summary["title"], "observer": "super_twisting", "assumptions": ASSUMPTIONS, "sides": proven}
        write_json(folder / "certificate.json", data)


def _proven(summary: JsonObject) -> JsonObject:
    """Certificates of the sides of which something is proven."""
    return {side: proof for side, proof in summary.get("certificates", {}).items() if proof["certified"]}


def certificate_lines(summary: JsonObject) -> list[str]:
    """The certificates in sentences."""
    certificates = summary.get("certificates", {}).items()
    return [line for side, proof in certificates for line in _lines(side, proof, summary["passed_over"][side])]


def is_refuted(summary: JsonObject) -> bool:
    """True if the search found an error above what was proven: that is said before all else."""
    return any(proof.get("search", {}).get("violations") for proof in summary.get("certificates", {}).values())


def _above(value: float, sign: float = 1.0) -> float:
    """Rounded up to four digits (to rounding errors): what is printed as proven must not say more than the proof."""
    if value == 0.0:
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return float(f"{sign * math.ceil(sign * value / unit - 1e-9) * unit:.4g}")


def _lines(side: str, proof: JsonObject, passed_over: int) -> list[str]:
    if not proof["certified"]:
        return [f"{side}: no certificate: {proof['why_none']}."]
    # what is assumed is rounded down
    bounds = {name: _above(value, -1.0) for name, value in proof["assumptions"].items() if name != "discretisation"}
    search = proof["search"]
    nominal = f", nominal acceleration of {bounds['acceleration']:.4g} rad/s²" if "acceleration" in bounds else ""
    promise = f"{_above(proof['accuracy']):.4g} rad/s"
    period = f"{proof['assumptions']['period']:.4g} s"
    lines = [
        f"{side}, promised: a velocity error of at most {promise} from {_above(proof['reaching_time']):.4g} s on, proven "
        f"(with {_above(proof['final_accuracy']):.4g} rad/s from {_above(proof['curve']['time'][-1]):.4g} s on) for any "
        f"noise within ±{bounds['noise']:.4g} rad and any missing acceleration within ±{bounds['f_plus']:.4g} rad/s²"
        f"{nominal}, sampled every {period}, from errors of {bounds['velocity_error']:.4g} rad/s "
        f"and {bounds['position_error']:.4g} rad.",
        f"{side}, tried: the worst of {search['runs']} adversarial runs errs by {search['worst']:.3g} rad/s. Another search "
        f"may find more, but not more than the {promise} that are promised.",
    ]
    missed = [
        f"{name.replace('_', ' ')} {limit['asked']:.3g} {'s' if name == 'reaching_time' else 'rad/s'}"
        for name, limit in proof["limits"].items()
        if not limit["met"]
    ]
    if missed:
        lines.insert(0, f"{side}, certificate: what was asked for is not proven: {', '.join(missed)}.")
    elif proof["limits"]:
        gains = f"; {passed_over} gains with less error in the runs do not" if passed_over else ""
        lines.append(f"{side}, certificate: the gains keep what was asked for{gains}.")
    return lines


def certificate_tables(summary: JsonObject) -> list[ResultTable]:
    """A table of what the certificates assume, if there are any."""
    assumptions = [[line] for line in ASSUMPTIONS]
    return [ResultTable("What the certificates assume", ["assumption"], assumptions)] if _proven(summary) else []
