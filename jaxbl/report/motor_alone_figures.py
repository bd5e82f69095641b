"""What the motor alone shows of a gap: the torque in the gear over the twist that the model makes of it, and how well each
half gap fits."""

import numpy as np

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.estimation.identify import Identification

from .figures import BLACK, BLUE, FAINT, VERMILION, Drawn, legend, limits, shade_gap, style, subplots

_CLOUD = 6000
"""Points of a cloud at most."""


@style()
def draw_motor_alone(result: Identification | Diagnosis) -> list[Drawn]:
    """Torque over twist, and the fit over the half gap; nothing where the model has no gap to be found."""
    if result.summary.get("backlash") is None:
        return []
    return [_hysteresis(result), _profile(result)]


def _hysteresis(result: Identification | Diagnosis) -> Drawn:
    unit, torque_unit = result.record.unit_of("motor.position", "rad"), result.record.unit_of("motor.torque", "N m")
    trace = result.trace.iloc[len(result.trace) // 10 :: max(1, len(result.trace) // _CLOUD)]
    ratio = float(result.model.build().plant.drive.ratio("load"))
    twist = (trace["theta_e"] - ratio * trace["load.modelled_position"]).to_numpy()
    by_motor, law = trace["torque_by_motor"].to_numpy(), trace["torque"].to_numpy()
    figure, (ax,) = subplots(9.0, 4.4)
    ax.plot(twist, by_motor, ".", ms=2.5, mew=0.0, color=BLUE, alpha=0.5, label="by the motor's side")
    ax.plot(twist, law, ".", ms=2.0, mew=0.0, color=BLACK, label="model")
    half = result.summary["backlash"]["half_gap"]
    if half:
        shade_gap(ax, half, f"gap: half width {half:.4g} {unit}")
    ax.set(xlabel=f"twist θe − N₀ θs, the load's position by the model ({unit})", xlim=limits(twist))
    ax.set(ylabel=f"torque in the gear ({torque_unit})", ylim=limits(by_motor, law))
    legend(ax, 3, markerscale=4.0)
    return Drawn(
        "hysteresis",
        figure,
        "Torque in the gear over the twist. Blue: what the motor's torque, smoothed acceleration and friction leave for the "
        "gear, which uses the motor's encoder only. Black: the model. Within the gap the motor drives nothing but itself. "
        "Smoothing rounds the impacts.",
    )


def _profile(result: Identification | Diagnosis) -> Drawn:
    gap, unit = result.summary["backlash"], result.record.unit_of("motor.position", "rad")
    figure, (ax,) = subplots(9.0, 3.6)
    half, deviance = np.array(gap["starts"], float).T
    ax.loglog(half, np.maximum(deviance, 0.1), "o-", color=FAINT, ms=4, lw=1.0, label="begun at this half gap, first fits")
    if gap["shown"]:
        ax.axvline(gap["half_gap"], color=BLUE, lw=1.2, label=f"half gap of the last fit: {gap['half_gap']:.4g} {unit}")
    else:
        ax.axvline(gap["at_most"], color=VERMILION, lw=1.2, label=f"not ruled out: up to {gap['at_most']:.3g} {unit}")
    ax.set(xlabel=f"half gap ({unit} at the motor)", ylabel="−2 log likelihood\nabove the least")
    legend(ax, 3)
    return Drawn(
        "half_gaps",
        figure,
        "How well half gaps fit: minus twice the log-likelihood of short fits begun at each, above that of the best. A "
        "clear valley is a gap that the log shows; without one any gap would do.",
    )
