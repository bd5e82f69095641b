"""A transmission alone, from Python: its table, its gear, and what of it a study can include."""

import numpy as np
import pandas as pd
import pytest
from measured import simulate_band

import jaxbl
from jaxbl.config import read_config


def test_two_displacements_and_their_gear_give_tables_of_a_study(tmp_path):
    random, t = np.random.default_rng(0), 0.01 * np.arange(1500)
    load = 1e-3 * np.sin(2.0 * np.pi * 0.11 * t)
    twist = 0.03 * np.sin(2.0 * np.pi * 0.4 * t) + 0.01 * np.sin(2.0 * np.pi * 0.7 * t)
    friction = 0.5 * np.sign(np.gradient(twist, t))
    frame = {"t": t, "u": 80.0 * twist + friction + 0.02 * random.standard_normal(1500)}
    frame |= {"theta_e": 10.0 * load + twist, "theta_s": load}
    path = tmp_path / "rig.csv"
    pd.DataFrame(frame).to_csv(path, index=False)
    identification = jaxbl.identify_element(path, {}, gear_ratio=10.0)
    assert identification.tables["transmission"]["law"] == "linear_shaft"
    assert identification.tables["transmission"]["stiffness"] == pytest.approx(80.0, rel=5e-3)
    (effect,) = identification.tables["effects"]
    assert effect["torque"] == pytest.approx(0.5, rel=0.02)
    drive = {"kind": "two_inertia", "motor_inertia": 0.1, "motor_viscous": 0.1, "load_inertia": 5.0, "load_viscous": 1.0}
    tables = {"drive": drive | {"gear_ratio": 10.0}, "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 1.0}}
    gains = {side: {"lambda": 1.0, "alpha": 1.0} for side in ("motor", "load")}
    assert read_config(tables | {"observer": gains} | identification.tables).effects[0].torque == effect["torque"]
    with pytest.raises(jaxbl.InputError, match="log: unknown key 'gear'"):
        jaxbl.identify_element(path, {"gear": 1})


def test_an_element_needs_its_displacement_in_every_log(tmp_path):
    t = 0.01 * np.arange(400)
    frame = pd.DataFrame({"t": t, "u": np.sin(t), "theta_e": 0.1 * np.sin(t), "theta_s": 0.01 * np.sin(t)})
    for name, columns in (("both", []), ("motor", ["theta_s"]), ("load", ["theta_e"])):
        frame.drop(columns=columns).to_parquet(tmp_path / f"{name}.parquet")
    both_sides, motor, load = (tmp_path / f"{name}.parquet" for name in ("both", "motor", "load"))
    for log, holdout in ((load, None), (both_sides, load), (motor, load)):
        with pytest.raises(
            jaxbl.InputError, match=r"load\.parquet: has no theta_e: an element is found from its displacement"
        ):
            jaxbl.identify_element(log, {}, holdout=holdout)
    with pytest.raises(jaxbl.InputError, match=r"load\.parquet: has no theta_e"):
        jaxbl.inspect(load, {"kind": "element"})
    for log, holdout in ((both_sides, motor), (motor, both_sides)):
        with pytest.raises(jaxbl.InputError, match=r"motor\.parquet: has no load position, which .*both\.parquet has"):
            jaxbl.identify_element(log, {}, holdout=holdout)


def test_a_band_is_reported_with_its_slip_or_what_was_found(tmp_path):
    """Play, spring and slip in series have no stiffness beside them: such rigs were refused."""
    random = np.random.default_rng(3)
    x, force, truth = simulate_band(random)
    pd.DataFrame({"t": 0.01 * np.arange(len(x)), "theta_e": x, "u": force}).to_csv(tmp_path / "band.csv", index=False)
    table = {"kind": "element", "theta_e": {"column": "theta_e", "unit": "m"}}
    band = jaxbl.identify_element(tmp_path / "band.csv", table)
    assert band.summary["parameters"]["slip"]["value"] == pytest.approx(truth["slip"], rel=0.02)
    assert any("no slip" in note for note in band.summary["notes"])
    assert band.tables["transmission"].keys() == {"law", "stiffness", "half_gap"}
    jaxbl.write_report(band, tmp_path / "out")
    assert "slip" in (tmp_path / "out" / "report.html").read_text()
    # friction alone: the stiffness stays open, and the friction is named
    force = 20.0 * np.sign(np.gradient(x)) + 0.1 * random.standard_normal(len(x))
    pd.DataFrame({"t": 0.01 * np.arange(len(x)), "theta_e": x, "u": force}).to_csv(tmp_path / "brake.csv", index=False)
    with pytest.raises(jaxbl.InputError, match=r"does not follow the displacement .*; what it shows: dry_friction 20"):
        jaxbl.identify_element(tmp_path / "brake.csv", table)
