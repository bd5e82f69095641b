"""What the motor alone shows of a gap: the torque in the gear over the twist that the model makes of it, and how well each
half gap fits."""

import numpy as np

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.identification.identify import Identification

from .figures import COLOURS, FAINT, SIDE_COLOURS, Drawn, legend, limits, style, subplots

_CLOUD = 6000
"""Points of a cloud at most."""
_GAP = "#F3E3A1"


@style()
def draw_motor_alone(found: Identification | Diagnosis) -> list[Drawn]:
    """Torque over twist, and the fit over the half gap; nothing where the model has no gap to be found."""
    if found.summary.get("backlash") is None:
        return []
    return [_hysteresis(found), _profile(found)]


def _hysteresis(found: Identification | Diagnosis) -> Drawn:
    trace, unit = found.trace, found.record.unit_of("motor.position", "rad")
    force = found.record.unit_of("motor.torque", "N m")
    plant = found.model.build().plant
    twist = trace["theta_e"].to_numpy() - float(plant.drive.ratio("load")) * trace["load.modelled_position"].to_numpy()
    by_motor, law = trace["torque_by_motor"].to_numpy(), trace["torque"].to_numpy()
    rows = np.arange(len(twist) // 10, len(twist))[:: max(1, len(twist) // _CLOUD)]
    figure, (ax,) = subplots(9.0, 4.4)
    ax.plot(
        twist[rows],
        by_motor[rows],
        ".",
        ms=2.5,
        mew=0.0,
        color=SIDE_COLOURS["motor"],
        alpha=0.5,
        label="by the motor's side",
    )
    ax.plot(twist[rows], law[rows], ".", ms=2.0, mew=0.0, color=COLOURS[6], label="model")
    half = found.summary["backlash"]["half_gap"]
    if half:
        ax.axvspan(-half, half, color=_GAP, alpha=0.6, lw=0.0, zorder=0, label=f"gap: half width {half:.4g} {unit}")
    ax.set(
        xlabel=f"twist θe − N₀ θs, the load's position by the model ({unit})", ylabel=f"torque in the gear ({force})",
        xlim=limits(twist[rows]), ylim=limits(by_motor[rows], law[rows]),
    )  # fmt: skip
    legend(ax, 3, markerscale=4.0)
    caption = (
        "Torque in the gear over the twist. Blue: what the motor's torque, smoothed acceleration and friction leave for the "
        "gear, which uses the motor's encoder only. Black: the model. Within the gap the motor drives nothing but itself. "
        "Smoothing rounds the impacts."
    )
    return Drawn("hysteresis", figure, caption)


def _profile(found: Identification | Diagnosis) -> Drawn:
    said, unit = found.summary["backlash"], found.record.unit_of("motor.position", "rad")
    figure, (ax,) = subplots(9.0, 3.6)
    half, deviance = np.array(said["starts"], float).T
    ax.loglog(half, np.maximum(deviance, 0.1), "o-", color=FAINT, ms=4, lw=1.0, label="begun at this half gap, first fits")
    if said["shown"]:
        ax.axvline(
            said["half_gap"], color=COLOURS[0], lw=1.2, label=f"half gap of the last fit: {said['half_gap']:.4g} {unit}"
        )
    else:
        ax.axvline(said["at_most"], color=COLOURS[1], lw=1.2, label=f"not ruled out: up to {said['at_most']:.3g} {unit}")
    ax.set(xlabel=f"half gap ({unit} at the motor)", ylabel="−2 log likelihood\nabove the least")
    legend(ax, 3)
    caption = (
        "How well half gaps fit: minus twice the log-likelihood of short fits begun at each, above that of the best. A "
        "clear valley is a gap that the log shows; without one any gap would do."
    )
    return Drawn("half_gaps", figure, caption)
