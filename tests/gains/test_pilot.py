"""Drives that gains must serve, and what pilot runs see of them."""

import numpy as np
import pytest
from small_study import rigid_study, small_study

from jaxbl.config import numeric_paths, read_config
from jaxbl.drive.parameters import leaf_paths
from jaxbl.gains.pilot import list_scenarios, run_pilot
from jaxbl.sweeps.trial import run


def list_corners(study, worst_over_uncertainty=True):
    return list_scenarios(read_config(study), worst_over_uncertainty)


def test_nominal_alone_unless_asked():
    assert list_corners(small_study(), False)[1:] == (("nominal",), {})


def test_corners_of_both_sides_at_once():
    pilot_data = list_corners(small_study({"uncertainty.relative": 0.1}))
    assert pilot_data.names[0] == "nominal"
    assert pilot_data.names[1] == "inertia -10 %, viscous -10 %"
    assert len(pilot_data.names) == 5
    np.testing.assert_allclose(pilot_data.columns["effects.motor.inertia.inertia"], 0.05 * 0.1 * np.array([0, -1, -1, 1, 1]))
    np.testing.assert_allclose(
        pilot_data.columns["effects.load.viscous_friction.viscous"], 16.0 * 0.1 * np.array([0, -1, 1, -1, 1])
    )
    assert set(pilot_data.columns) <= set(leaf_paths(pilot_data.config.build())) & set(numeric_paths(pilot_data.config))


def test_what_is_known_exactly_stays():
    pilot_data = list_corners(
        small_study({"uncertainty.exact": ["drive.motor_inertia", "drive.load_inertia", "drive.load_viscous"]})
    )
    assert list(pilot_data.columns) == ["effects.motor.viscous_friction.viscous"]
    assert len(pilot_data.names) == 3
    everything = [f"drive.{side}_{number}" for side in ("motor", "load") for number in ("inertia", "viscous")]
    assert list_corners(small_study({"uncertainty.exact": everything})).names == ("nominal",)


def test_one_inertia_without_friction():
    pilot_data = list_corners(rigid_study({"drive.motor_viscous": 0.0}))
    assert list(pilot_data.columns) == ["effects.motor.inertia.inertia"]
    assert pilot_data.names == ("nominal", "inertia -2 %", "inertia +2 %")


@pytest.mark.parametrize("count", [1, 2])
def test_effects_that_the_study_has_are_varied_about_their_values(count):
    effects = [{"kind": "motor.coulomb_friction", "torque": 0.01}, *[{"kind": "motor.inertia", "inertia": 0.01}] * count]
    exact = ["effects.motor.inertia.inertia"] if count == 1 else ["effects.1.inertia"]
    pilot_data = list_corners(small_study({"uncertainty.exact": exact}, effects=effects))
    # two of a kind go by position
    path = "effects.motor.inertia.inertia" if count == 1 else "effects.1.inertia"
    np.testing.assert_allclose(pilot_data.columns[path], 0.01 + 0.001 * np.array([0, -1, -1, 1, 1]))
    assert set(pilot_data.columns) <= set(leaf_paths(pilot_data.config.build())) & set(numeric_paths(pilot_data.config))


def test_pilot_agrees_with_the_trace_of_a_run():
    study = small_study(
        {"observer.motor.velocity_error": 0.0, "observer.load.velocity_error": 0.3, "excitation.amplitude": 0.5}
    )
    pilot_data = run_pilot(list_corners(study, False))
    trace, drive = run(study).trace, {"motor": (0.05, 0.15), "load": (7.0, 16.0)}
    for side, (inertia, viscous) in drive.items():
        driving = trace["u"] if side == "motor" else 0.0
        unknown = (trace[f"{side}.acceleration"] - (driving - viscous * trace[f"{side}.velocity"]) / inertia).abs()
        assert pilot_data[side]["disturbance"] == pytest.approx(unknown.max(), rel=1e-9)
        assert pilot_data[side]["largest_velocity"] == pytest.approx(trace[f"{side}.velocity"].abs().max())
        error = pilot_data[side]["velocity_error"]
        assert pilot_data[side]["start"] == pytest.approx(unknown.iloc[0] + viscous / inertia * error)
    assert pilot_data["load"]["f_plus"] == max(pilot_data["load"]["disturbance"], pilot_data["load"]["start"])
    # none given: the largest velocity of the run, whose friction brakes the error
    assert pilot_data["motor"]["f_plus"] == pilot_data["motor"]["disturbance"] < pilot_data["motor"]["start"]
    assert pilot_data["motor"]["velocity_error"] == pilot_data["motor"]["largest_velocity"]
    assert pilot_data["motor"]["starting_error_assumed"] and not pilot_data["load"]["starting_error_assumed"]
    assert pilot_data["load"]["velocity_error"] == 0.3


def test_pilot_takes_the_worst_drive():
    study = small_study({"uncertainty.relative": 0.3, "excitation.amplitude": 0.5})
    nominal, worst = (run_pilot(list_corners(study, worst)) for worst in (False, True))
    for side in ("motor", "load"):
        assert worst[side]["f_plus"] > nominal[side]["f_plus"]
