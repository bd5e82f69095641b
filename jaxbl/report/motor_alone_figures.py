"""What the motor alone shows of a gap: the torque in the gear over the twist that the model makes of it, and how well each
half gap fits."""

import numpy as np

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.estimation.identify import Identification

from .panels import BLACK, BLUE, FAINT, VERMILION, Axis, Figure, Line, Panel, Part, Span, cloud, limits, shade_gap


def draw_motor_alone(result: Identification | Diagnosis) -> list[Figure]:
    """Torque over twist, and the fit over the half gap; nothing where the model has no gap to be found."""
    if result.summary.get("backlash") is None:
        return []
    return [_hysteresis(result), _profile(result)]


def _hysteresis(result: Identification | Diagnosis) -> Figure:
    unit, torque_unit = result.record.unit_of("motor.position", "rad"), result.record.unit_of("motor.torque", "N m")
    trace, half = result.trace.iloc[len(result.trace) // 10 :], result.summary["backlash"]["half_gap"]
    ratio = float(result.model.build().plant.drive.ratio("load"))
    twist = (trace["theta_e"] - ratio * trace["load.modelled_position"]).to_numpy()
    by_motor, law = trace["torque_by_motor"].to_numpy(), trace["torque"].to_numpy()
    parts: list[Part] = [cloud(twist, by_motor, "by the motor's side", BLUE), cloud(twist, law, "model", BLACK)]
    if half:
        parts.insert(0, shade_gap(half, f"gap: half width {half:.4g} {unit}"))
    x = Axis(f"twist θe − N₀ θs, the load's position by the model ({unit})", ends=limits(twist))
    return Figure(
        "hysteresis",
        [Panel(x, Axis(f"torque in the gear ({torque_unit})", ends=limits(by_motor, law)), parts)],
        "Torque in the gear over the twist. Blue: what the motor's torque, smoothed acceleration and friction leave for the "
        "gear, which uses the motor's encoder only. Black: the model. Within the gap the motor drives nothing but itself. "
        "Smoothing rounds the impacts.",
    )


def _profile(result: Identification | Diagnosis) -> Figure:
    gap, unit = result.summary["backlash"], result.record.unit_of("motor.position", "rad")
    half, deviance = np.array(gap["starts"], float).T
    place, name, colour = gap["half_gap"], "half gap of the last fit:", BLUE
    if not gap["shown"]:
        place, name, colour = gap["at_most"], "not ruled out: up to", VERMILION
    parts = [
        Line(half, np.maximum(deviance, 0.1), "begun at this half gap, first fits", FAINT, 1.0, marker="o", size=4.0),
        Span(place, place, f"{name} {place:.4g} {unit}", colour, dashes="-", width=1.2),
    ]
    return Figure(
        "half_gaps",
        [
            Panel(
                Axis(f"half gap ({unit} at the motor)", log=True),
                Axis("−2 log likelihood\nabove the least", log=True),
                parts,
            )
        ],
        "How well half gaps fit: minus twice the log-likelihood of short fits begun at each, above that of the best. A "
        "clear valley is a gap that the log shows; without one any gap would do.",
    )
