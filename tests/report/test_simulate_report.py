"""Figures of a single run."""

import pytest
from small_study import rigid_study, small_study

from jaxbl.report.drawing import save
from jaxbl.report.simulate import describe, draw as draw_trial
from jaxbl.sweeps.trial import run

AT_REST = ["torque", "motor_velocity", "load_velocity", "hysteresis"]
# the load's error has no two peaks beyond its chatter
BOTH_SIDES = [*AT_REST[:3], "gain_conditions_motor", "gain_conditions_load", "error_plane_motor", "hysteresis"]
CASES = {
    "sigmoid": (small_study({"run.duration": 1.0}), BOTH_SIDES),
    "dead zone": (small_study(transmission={"law": "dead_zone", "stiffness": 1.0, "half_gap": 0.01}), BOTH_SIDES),
    "shaft": (small_study(transmission={"law": "linear_shaft", "stiffness": 1.0}), BOTH_SIDES),
    "rigid": (rigid_study(), ["torque", "motor_velocity", "gain_conditions_motor", "error_plane_motor"]),
    "closed loop": (
        small_study(controller={"kind": "cascade", "position_gain": 5.0, "speed_gain": 1.0},
                    reference={"kind": "sine", "amplitude": 0.1, "frequency": 2.0}),
        [*BOTH_SIDES[:3], "following", *BOTH_SIDES[3:]],
    ),
    # nothing moves, nothing is identified
    "at rest": (
        small_study({"excitation.amplitude": 0.0, "encoders.noise": 0.0, "observer.motor.velocity_error": 0.0}), AT_REST
    ),
    "not identified": (small_study({"identifier.start": 10.0}), BOTH_SIDES),
    "diverged": (rigid_study(effects=[{"kind": "motor.viscous_friction", "viscous": 1e4}]), ["torque", "motor_velocity"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_all_figures_are_drawn_with_units(tmp_path, case):
    data, names = CASES[case]
    drawings = [*draw_trial(run(data))]
    assert [d.name for d in drawings] == names
    for d in drawings:
        assert d.caption.endswith(".")
        assert save(d, tmp_path / f"{d.name}.png").stat().st_size > 5000
        for panel in d.panels:
            assert "(" in panel.y.label, d.name
        assert "(" in d.panels[-1].x.label or d.name.startswith("error_plane")


@pytest.mark.parametrize(("lambda_", "verdict"), [(1e-3, "doubtful"), (4.0, "good")])
def test_a_run_that_converges_is_good_only_if_the_exact_condition_ensures_it(lambda_, verdict):
    """Both begin without an error, and stay small whatever the gains; the condition asks for about 0.006 √rad/s."""
    start = {"run.duration": 2.0, "encoders.noise": 1e-6, "observer.motor.velocity_error": 0.0, "observer.motor.alpha": 3.0}
    trial = run(rigid_study(start | {"observer.motor.lambda": lambda_}))
    assert trial.summary["metrics"]["motor.converged"]
    found = describe(trial)
    assert found.verdict == verdict
    assert ("the gains of the motor observer do not ensure that" in found.headline) == (verdict == "doubtful")
