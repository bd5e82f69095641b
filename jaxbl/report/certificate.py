"""What a certificate of `jaxbl tune` says: sentences, a table, and `certificate.json` beside the gains."""

import math
from pathlib import Path

from jaxbl.files import json_with_checksum, remove, write_atomic
from jaxbl.json_types import JsonObject

from .figures import COLOURS, Drawn, style, subplots
from .page import PageTable

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
    """Write `certificate.json` of the sides of which something is proven; where there is none, remove an earlier one."""
    proven = {side: found for side, found in summary.get("certificates", {}).items() if found["certified"]}
    if not proven:
        remove(folder / "certificate.json")
        return
    data = {"title": summary["title"], "observer": "super_twisting", "assumptions": list(ASSUMPTIONS), "sides": proven}
    write_atomic(folder / "certificate.json", json_with_checksum(data))


def certificate_lines(summary: JsonObject) -> list[str]:
    """The certificates in sentences."""
    found = summary.get("certificates", {})
    return [line for side in found for line in _lines(side, found[side], summary["passed_over"][side])]


def is_refuted(summary: JsonObject) -> bool:
    """Whether the search found an error above what was proven: that is said before all else."""
    return any(found.get("search", {}).get("violations") for found in summary.get("certificates", {}).values())


def _above(value: float, sign: float = 1.0) -> float:
    """Rounded up to four digits (to rounding errors): what is printed as proven must not say more than the proof."""
    if value == 0.0:
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return float(f"{sign * math.ceil(sign * value / unit - 1e-9) * unit:.4g}")


def _below(value: float) -> float:
    """Rounded down, for what is assumed."""
    return _above(value, -1.0)


def _lines(side: str, found: JsonObject, passed_over: int) -> list[str]:
    if not found["certified"]:
        return [f"{side}: no certificate: {found['why_none']}."]
    given = {name: _below(value) for name, value in found["assumptions"].items() if name != "discretisation"}
    tried = found["search"]
    nominal = f", nominal acceleration of {given['acceleration']:.4g} rad/s²" if "acceleration" in given else ""
    promise = f"{_above(found['accuracy']):.4g} rad/s"
    lines = [
        f"{side}, promised: a velocity error of at most {promise} from {_above(found['reaching_time']):.4g} s on, proven "
        f"(with {_above(found['final_accuracy']):.4g} rad/s from {_above(found['curve']['time'][-1]):.4g} s on) for any "
        f"noise within ±{given['noise']:.4g} rad and any missing acceleration within ±{given['f_plus']:.4g} rad/s²{nominal}"
        f", sampled every {found['assumptions']['period']:.4g} s, from errors of {given['velocity_error']:.4g} rad/s and "
        f"{given['position_error']:.4g} rad.",
        f"{side}, tried: the worst of {tried['runs']} adversarial runs errs by {tried['worst']:.3g} rad/s. Another search "
        f"may find more, but not more than the {promise} that are promised.",
    ]
    missed = [
        f"{name.replace('_', ' ')} {limit['asked']:.3g} {'s' if name == 'reaching_time' else 'rad/s'}"
        for name, limit in found["limits"].items()
        if not limit["met"]
    ]
    if missed:
        lines.insert(0, f"{side}, certificate: what was asked for is not proven: {', '.join(missed)}.")
    elif found["limits"]:
        gains = f"; {passed_over} gains with less error in the runs do not" if passed_over else ""
        lines.append(f"{side}, certificate: the gains keep what was asked for{gains}.")
    return lines


def certificate_tables(summary: JsonObject) -> list[PageTable]:
    """The certificates' numbers and assumptions, if there are any."""
    found = {side: one for side, one in summary.get("certificates", {}).items() if one["certified"]}
    if not found:
        return []
    names = ["promised accuracy (rad/s)", "promised from (s)", "proven later (rad/s)", "that from (s)",
             "worst found (rad/s)", "proven later / found", "found from (s)", "without noise, continuous (s)", "noise (rad)",
             "f⁺ (rad/s²)", "period (s)", "velocity error at start (rad/s)", "position error at start (rad)"]  # fmt: skip
    sides = [
        [*(_above(one[name]) for name in ("accuracy", "reaching_time", "final_accuracy")), _above(one["curve"]["time"][-1]),
         one["search"]["worst"],
         one["search"]["ratio"], one["search"]["reaching_time"], one["reaching_time_continuous"],
         *(one["assumptions"][name] if name == "period" else _below(one["assumptions"][name])
           for name in ("noise", "f_plus", "period", "velocity_error", "position_error"))]
        for one in found.values()
    ]  # fmt: skip
    columns, rows = ["", *found], list(zip(names, *sides, strict=True))
    table = PageTable("Certificates: proven for any noise and disturbance within the bounds", columns, rows)
    return [table, PageTable("What the certificates assume", ["assumption"], [[line] for line in ASSUMPTIONS])]


@style()
def draw_certificates(summary: JsonObject) -> list[Drawn]:
    """The proven bound over time on each side, and the worst that was found."""
    return [_bounds(side, one) for side, one in summary.get("certificates", {}).items() if one["certified"]]


def _bounds(side: str, found: JsonObject) -> Drawn:
    figure, (ax,) = subplots(6.6, 4.4, beside=True)
    curve, tried = found["curve"], found["search"]
    # beyond its last point the bound stays as it is
    end = max(1.3 * found["reaching_time"], curve["time"][-1], 20.0 * found["assumptions"]["period"])
    ax.step(
        [*curve["time"], end], [*curve["bound"], curve["bound"][-1]], where="post", color=COLOURS[0], label="proven bound"
    )
    ax.axhline(tried["worst"], color=COLOURS[1], ls="--", label="worst found, from rest")
    ax.plot(found["reaching_time"], found["accuracy"], "o", ms=7, color=COLOURS[0], label="proven from here on")
    ax.set(xlabel="time (s)", ylabel="velocity error (rad/s)", yscale="log", title=side, xlim=(0.0, end))
    figure.legend(loc="outside lower center", ncols=3)
    caption = (
        f"{side}: bound of the error of the estimated velocity, whatever noise and missing acceleration do within what is "
        f"assumed, and the worst of {tried['runs']} adversarial runs."
    )
    return Drawn(f"certificate_{side}", figure, caption)
