"""Drives that gains must serve, and what pilot runs see of them."""

import numpy as np
import pytest
from small_study import rigid, small

from jaxbl.config import TuneTable, numeric_paths, read_config
from jaxbl.drive.parameters import leaf_paths
from jaxbl.gains.pilot import list_scenarios, run_pilot
from jaxbl.sweeps.trial import run

WORST = TuneTable(worst_over_uncertainty=True)


def corners(study, table=WORST):
    return list_scenarios(read_config(study), table)


def test_nominal_alone_unless_asked():
    assert corners(small(), TuneTable())[1:] == (["nominal"], {})


def test_corners_of_both_sides_at_once():
    found = corners(small({"uncertainty.relative": 0.1}))
    assert found.names[0] == "nominal"
    assert found.names[1] == "inertia -10 %, viscous -10 %"
    assert len(found.names) == 5
    np.testing.assert_allclose(found.columns["effects.motor.inertia.inertia"], 0.05 * 0.1 * np.array([0, -1, -1, 1, 1]))
    np.testing.assert_allclose(
        found.columns["effects.load.viscous_friction.viscous"], 16.0 * 0.1 * np.array([0, -1, 1, -1, 1])
    )
    assert set(found.columns) <= set(leaf_paths(found.config.build())) & set(numeric_paths(found.config))


def test_what_is_known_exactly_stays():
    found = corners(small({"uncertainty.exact": ["drive.motor_inertia", "drive.load_inertia", "drive.load_viscous"]}))
    assert list(found.columns) == ["effects.motor.viscous_friction.viscous"]
    assert len(found.names) == 3
    everything = [f"drive.{side}_{number}" for side in ("motor", "load") for number in ("inertia", "viscous")]
    assert corners(small({"uncertainty.exact": everything})).names == ["nominal"]


def test_one_inertia_without_friction():
    found = corners(rigid({"drive.motor_viscous": 0.0}))
    assert list(found.columns) == ["effects.motor.inertia.inertia"]
    assert found.names == ["nominal", "inertia -2 %", "inertia +2 %"]


@pytest.mark.parametrize("count", [1, 2])
def test_effects_that_the_study_has_are_varied_about_their_values(count):
    effects = [{"kind": "motor.coulomb_friction", "torque": 0.01}, *[{"kind": "motor.inertia", "inertia": 0.01}] * count]
    exact = ["effects.motor.inertia.inertia"] if count == 1 else ["effects.1.inertia"]
    found = corners(small({"uncertainty.exact": exact}, effects=effects))
    # two of a kind go by position
    path = "effects.motor.inertia.inertia" if count == 1 else "effects.1.inertia"
    np.testing.assert_allclose(found.columns[path], 0.01 + 0.001 * np.array([0, -1, -1, 1, 1]))
    assert set(found.columns) <= set(leaf_paths(found.config.build())) & set(numeric_paths(found.config))


def test_pilot_agrees_with_the_trace_of_a_run():
    study = small({"observer.motor.velocity_error": 0.0, "observer.load.velocity_error": 0.3, "excitation.amplitude": 0.5})
    found = run_pilot(corners(study, TuneTable()), TuneTable())
    trace, drive = run(study).trace, {"motor": (0.05, 0.15), "load": (7.0, 16.0)}
    for side, (inertia, viscous) in drive.items():
        driving = trace["u"] if side == "motor" else 0.0
        unknown = (trace[f"{side}.acceleration"] - (driving - viscous * trace[f"{side}.velocity"]) / inertia).abs()
        assert found[side]["disturbance"] == pytest.approx(unknown.max(), rel=1e-9)
        assert found[side]["largest_velocity"] == pytest.approx(trace[f"{side}.velocity"].abs().max())
        error = found[side]["velocity_error"]
        assert found[side]["start"] == pytest.approx(unknown.iloc[0] + viscous / inertia * error)
        assert found[side]["f_plus"] == max(found[side]["disturbance"], found[side]["start"])
    # none given: the largest velocity of the run
    assert found["motor"]["velocity_error"] == found["motor"]["largest_velocity"]
    assert found["motor"]["starting_error_assumed"] and not found["load"]["starting_error_assumed"]
    assert found["load"]["velocity_error"] == 0.3


def test_pilot_takes_the_worst_drive():
    study = small({"uncertainty.relative": 0.3, "excitation.amplitude": 0.5})
    nominal, worst = (run_pilot(corners(study, table), table) for table in (TuneTable(), WORST))
    for side in ("motor", "load"):
        assert worst[side]["f_plus"] > nominal[side]["f_plus"]
