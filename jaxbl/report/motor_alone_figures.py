"""What the motor alone shows of a gap: the torque in the gear over the twist that the model makes of it."""

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.estimation.identify import Identification

from .panels import BLACK, BLUE, Axis, Figure, Panel, cloud, limits, shade_gap


def draw_motor_alone(result: Identification | Diagnosis) -> Figure:
    """Draw the torque in the gear over the twist, by the motor's side and of the model, with the gap if there is one."""
    unit, torque_unit = result.record.unit_of("motor.position", "rad"), result.record.unit_of("motor.torque", "N m")
    trace, gap = result.trace.iloc[len(result.trace) // 10 :], result.summary["backlash"]
    ratio = float(result.model.build().plant.drive.ratio("load"))
    twist = (trace["theta_e"] - ratio * trace["load.modelled_position"]).to_numpy()
    by_motor, law = trace["torque_by_motor"].to_numpy(), trace["torque"].to_numpy()
    half = (gap and gap["half_gap"]) or 0.0
    clouds = cloud(twist, by_motor, "by the motor's side", BLUE), cloud(twist, law, "model", BLACK)
    parts = [*shade_gap(half, f"gap: half width {half:.4g} {unit}"), *clouds]
    x = Axis(f"twist θe − N₀ θs, the load's position by the model ({unit})", ends=limits(twist))
    return Figure(
        "hysteresis",
        [Panel(x, Axis(f"torque in the gear ({torque_unit})", ends=limits(by_motor, law)), parts)],
        "Torque in the gear over the twist. Blue: what the motor's torque, smoothed acceleration and friction leave for the "
        "gear, which uses the motor's encoder only. Black: the model. Within the gap the motor drives nothing but itself. "
        "Smoothing rounds the impacts.",
    )
