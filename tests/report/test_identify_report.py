"""Figures and words of an identification, on made results: every law, gaps in the log, a measured torque, a linear axis."""

import dataclasses
import functools
import json

import jax.numpy as jnp
import numpy as np
import pytest
from browser import check_figures, needs_chromium, open_pages
from panel_parts import names_of
from small_study import rigid_study, small_study

from jaxbl.config import read_config
from jaxbl.estimation.identify import Identification
from jaxbl.estimation.regression import Kinematics, model_torques
from jaxbl.records import read_record
from jaxbl.records.least_squares import rms
from jaxbl.report.drawing import save
from jaxbl.report.identify import LogSignals, describe as describe_identification, draw as draw_identification
from jaxbl.report.results import write_report
from jaxbl.sweeps.trial import run

GEARED = ["hysteresis", "residuals"]
RIGID = ["friction", "residuals"]
MOTION = {
    "excitation": {"kind": "multisine", "amplitude": 5.0, "frequency": 0.5},
    "observer": {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}},
}
SHORT_RUN = {"run.duration": 1.0, "run.sample_period": 2e-3, "run.substeps": 4, "identifier.start": 0.2}
DEAD_ZONE = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}


def geared_study(changes=None, **tables):
    return small_study(SHORT_RUN | (changes or {}), **({"transmission": DEAD_ZONE} | MOTION | tables))


def draw_by_name(result):
    return {drawing.name: drawing for drawing in draw_identification(result)}


@functools.cache
def _trace(study: str):
    """The trace of a study given as JSON: several tests look at the same one."""
    return run(json.loads(study)).trace


def regression_torques(config, trace, sides):
    columns = (
        {side: jnp.asarray(trace[f"{side}.{name}"]) for side in sides} for name in ("position", "velocity", "acceleration")
    )
    kinematics = Kinematics(jnp.asarray(trace["t"]), jnp.asarray(trace["u"]), *columns)
    deviation = {side: jnp.asarray(trace[f"{side}.velocity_deviation"]) for side in sides}
    return model_torques(config.build(), kinematics, deviation)


def make_identification(data, folder, *, gap=False, unit="rad", transmitted=False, held=()):
    """The identification that has the numbers of the study itself."""
    config = read_config(data)
    truth = _trace(json.dumps(data)).copy()
    sides = [side for side in ("motor", "load") if f"{side}.position" in truth]
    columns = ["t", "u", "theta_e", "theta_s"][: 2 + len(sides)]
    frame = truth[columns].drop(index=range(100, 120)) if gap else truth[columns]
    frame.to_csv(folder / "log.csv", index=False)
    log = {column: {"column": column, "unit": "m"} for column in columns[2:]} if unit == "m" else None
    record = read_record(folder / "log.csv", log)
    trace = truth.loc[frame.index].reset_index(drop=True).rename(columns={"z": "twist"})
    trace["t"] = record.time
    for side in sides:
        trace[f"{side}.velocity_deviation"] = trace[f"{side}.acceleration_deviation"] = 1e-3
        trace[f"{side}.acceleration"] = np.gradient(trace[f"{side}.velocity"], record.sample_period)
        trace[f"{side}.residual"] = 1e-4 * np.random.default_rng(0).standard_normal(len(trace))
    for name, values in regression_torques(config, trace, sides).items():
        trace[name] = np.asarray(values)
    if transmitted:
        trace["transmitted"] = truth["torque"]
    names = [name for name in ("stiffness", "dead_zone", "half_gap") if f"motor.{name}" in trace]
    if gap:
        # as of the observers, which run on the longest part alone
        chain = ["twist", *(f"{s}.{n}" for s in sides for n in ("velocity_estimate", "torque_estimate", *names))]
        longest = max(record.segments, key=lambda segment: segment.stop - segment.start)
        outside = np.ones(len(trace), bool)
        outside[longest] = False
        trace.loc[outside, chain] = np.nan
    numbers = {"drive.motor_inertia": ("kg m²", 0.05), "drive.motor_viscous": ("N m s/rad", 0.15)}
    parameters = {
        path: {"value": value, "standard_error": 1e-3, "interval": [value - 2e-3, value + 2e-3],
               "unit": record.unit_of(path, kind),
               "nominal": 1.1 * value} for path, (kind, value) in numbers.items()
    }  # fmt: skip
    if "half_gap" in names:
        parameters["transmission.half_gap"] = {"value": 0.08, "standard_error": 1e-4, "interval": [0.0798, 0.0802]}
    summary = {
        "title": "",
        "file": str(record.path),
        "parameters": parameters,
        "refused": [],
        "held": list(held),
        "residual": {side: {"rms": 1e-4, "noise": 1e-4, "unit": unit} for side in sides},
        "torque": {},
        "warnings": [],
        "notes": [],
        "method": {
            "recursive": {name: {side: float(trace[f"{side}.{name}"].iloc[-1]) for side in sides} for name in names},
            "trajectory": {"window": 0.5, "windows": 2, "converged": True, "starts": 2, "starts_agreeing": 2},
        },
    }
    return Identification(config, config, record, summary, trace, False)


CASES = {
    "dead zone": (geared_study(), {}, GEARED),
    "sigmoid": (
        geared_study(transmission={"law": "sigmoid_backlash", "stiffness": 60.0, "dead_zone": 0.02, "slope": 80.0}),
        {},
        GEARED,
    ),
    "shaft": (geared_study(transmission={"law": "linear_shaft", "stiffness": 60.0}), {}, GEARED),
    "gap": (geared_study(), {"gap": True, "held": ["drive.load_inertia"]}, GEARED),
    "measured": (geared_study({"run.duration": 10.0}), {"transmitted": True}, GEARED),
    "effects": (geared_study(effects=[{"kind": "transmission.backlash", "half_gap": 0.01},
                                {"kind": "transmission.damping", "damping": 0.1},
                                {"kind": "transmission.eccentricity", "amplitude": 0.01},
                                {"kind": "motor.inertia", "inertia": 0.01},
                                {"kind": "actuator.lag", "time_constant": 0.01}]), {}, GEARED),
    "rigid": (rigid_study(SHORT_RUN | {"identifier.start": None}), {}, RIGID),
    "linear": (
        rigid_study(SHORT_RUN | {"identifier.start": None}, effects=[{"kind": "motor.coulomb_friction", "torque": 0.02}]),
        {"unit": "m"},
        RIGID,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_all_figures_are_drawn_with_units(case, tmp_path):
    data, options, names = CASES[case]
    result = make_identification(data, tmp_path, **options)
    drawings = [*draw_identification(result)]
    assert [drawing.name for drawing in drawings] == names
    for drawing in drawings:
        assert drawing.caption.endswith(".")
        assert save(drawing, tmp_path / f"{drawing.name}.png").stat().st_size > 5000
        assert "(" in drawing.panels[0].y.label, drawing.name
        assert "(" in drawing.panels[-1].x.label, drawing.name
    panels = {drawing.name: drawing.panels for drawing in drawings}
    if case == "measured":
        assert [panel.title for panel in panels["hysteresis"]] == [
            "by the motor side",
            "by the load side",
            "measured",
        ]
    if case == "shaft":
        assert not any("gap" in text for text in names_of(panels["hysteresis"][0]))
    if case == "effects":
        assert any("half width 0.09" in text for text in names_of(panels["hysteresis"][0]))


@needs_chromium
def test_the_page_in_a_browser(tmp_path):
    write_report(make_identification(CASES["dead zone"][0], tmp_path), tmp_path)
    with open_pages(tmp_path / "report.html") as (page,):
        check_figures(page, len(GEARED))


def test_a_linear_axis_has_newtons_and_metres(tmp_path):
    result = make_identification(CASES["linear"][0], tmp_path, unit="m")
    described = write_report(result, tmp_path)
    assert ("0.0500 ± 0.0010 kg", "drive.motor_inertia") in described.key_figures
    assert ("0.1500 ± 0.0010 N s/m", "drive.motor_viscous") in described.key_figures
    assert "motor: 0.0001 m rms" in described.headline
    drawings = draw_by_name(result)
    (panel,) = drawings["friction"].panels
    assert panel.x.label == "velocity by the smoother (m/s)"
    assert panel.y.label == "resisting force (N)"
    assert "kg m²" not in (tmp_path / "report.html").read_text()


def test_torque_of_a_side_is_less_the_effects_on_it(tmp_path):
    """Friction of 1 N m on the motor and 5 N m on the load is not mistaken for transmitted torque."""
    friction = [{"kind": "motor.coulomb_friction", "torque": 1.0}, {"kind": "load.coulomb_friction", "torque": 5.0}]
    result = make_identification(geared_study({"run.duration": 2.0}, effects=friction), tmp_path)
    bare_result = dataclasses.replace(result, trace=result.trace.drop(columns=["motor.effects", "load.effects"]))
    errors = []
    for found in (result, bare_result):
        log = LogSignals(found)
        law = log.low_passed(log["torque"])
        errors.append(min(rms((torque - law)[log.settled]) for torque in map(log.torque_by, log.sides)))
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.usefixtures("every_figure_drawn")
def test_observers_that_diverged_leave_figures(tmp_path):
    result = make_identification(geared_study(), tmp_path)
    trace = result.trace.copy()
    for name in ("motor.velocity_estimate", "motor.torque_estimate", "motor.stiffness", "motor.half_gap"):
        trace[name] = np.nan
    drawings = [*draw_identification(dataclasses.replace(result, trace=trace))]
    assert [drawing.name for drawing in drawings] == GEARED
    for drawing in drawings:
        save(drawing, tmp_path / f"{drawing.name}.png")


def test_gains_of_which_none_follows_the_log_are_not_called_chosen(tmp_path):
    result = make_identification(geared_study(), tmp_path)
    gains = {"motor": {"lambda_": 70.0, "alpha": 4600.0, "f_plus": 4200.0, "velocity_error": None}}
    lines = write_report(dataclasses.replace(result, summary=result.summary | {"gains": gains}), tmp_path).details
    assert [line.startswith("motor observer: no gains") for line in lines if "observer: " in line] == [True]


@pytest.mark.parametrize(("factor", "doubtful"), [(1000.0, True), (1.5, False)])
def test_an_inertia_far_from_what_is_known_of_it_comes_first(factor, doubtful):
    estimate = {"value": 2e-4 * factor, "nominal": 2e-4, "standard_error": 1e-6, "interval": [0.0, 1.0], "unit": "kg m²"}
    summary = {
        "title": "", "file": "log.csv", "warnings": [], "residual": {}, "parameters": {"drive.motor_inertia": estimate},
        "refused": [], "held": [], "torque": {}, "notes": [],
        "method": {
            "recursive": {},
            "trajectory": {"converged": True, "windows": 1, "window": 1.0, "starts_agreeing": 1, "starts": 1},
        },
    }  # fmt: skip
    result = describe_identification(summary)
    assert result.headline.startswith("drive.motor_inertia is 1e+03 times its nominal value: a unit,") is doubtful
    assert result.verdict == ("doubtful" if doubtful else "good")
