"""Studies over the kind of observer: gains of several kinds beside one another, by both loops."""

import numpy as np
import pytest
import tomli_w
from small_study import listed_axis, rigid_study, small_study

import jaxbl
from jaxbl.config import numeric_paths, read_config
from jaxbl.drive.parameters import parameters
from jaxbl.errors import InputError
from jaxbl.observer import OBSERVERS
from jaxbl.observer.base import OperatingConditions

GAINS = {
    "lambda": 4.0,
    "alpha": 9.0,
    "bandwidth": 150.0,
    "damping": 0.8,
    "position_noise": 1e-5,
    "disturbance_noise": 100.0,
    "time_constant": 0.004,
    "lipschitz": 50.0,
}


def study(**tables):
    return small_study(observer={"motor": GAINS, "load": GAINS}, encoders={"noise": 1e-5}) | tables


def sweep_kinds(kinds, backend):
    axes = [listed_axis("observer.kind", *kinds), listed_axis("drive.motor_inertia", 0.05, 0.06)]
    return jaxbl.sweep(rigid_study(observer={"motor": GAINS}, encoders={"noise": 1e-5}, axes=axes), backend=backend).frame


def test_a_sweep_over_the_kind_by_both_loops():
    fused = sweep_kinds(OBSERVERS, "fused")
    # differentiators of order 5 take all operations that those of order 2 to 4 do
    scanned = sweep_kinds([kind for kind in OBSERVERS if kind[-1] not in "234"], "scan")
    assert list(fused["observer.kind"].unique()) == list(OBSERVERS)
    conditions = [name for name in fused if "margin" in name or "bound" in name or "worst" in name]
    usual = fused["observer.kind"] == "super_twisting"
    assert len(conditions) == 8
    # conditions on lambda and alpha are not for the others
    assert fused.loc[usual, conditions].notna().all(axis=None)
    assert fused.loc[~usual, conditions].isna().all(axis=None)
    numbers = [name for name in fused if name not in (*conditions, "observer.kind", "motor.convergence_time")]
    assert fused["finite"].all()
    same = fused[fused["observer.kind"].isin(scanned["observer.kind"])]
    np.testing.assert_allclose(same[numbers].astype(float), scanned[numbers].astype(float), rtol=1e-5, atol=1e-9)
    # each kind does something of its own
    assert fused["motor.velocity_rmse"].nunique() == len(fused)


def test_an_axis_over_gains_needs_kinds_that_have_them():
    kinds = {"path": "observer.kind", "values": ["luenberger", "extended_state"]}
    shared = {"path": "observer.motor.bandwidth", "values": [100.0, 200.0]}
    frame = jaxbl.sweep(study(axes=[kinds, shared], sweep={"metrics": ["velocity_rmse"]})).frame
    assert frame["motor.velocity_rmse"].nunique() == 4
    kinds["values"].append("kalman")
    with pytest.raises(InputError, match=r"axes\[1\]: 'observer.motor.bandwidth' is no gain of kind 'kalman'"):
        jaxbl.sweep(study(axes=[kinds, shared]))


@pytest.mark.parametrize(
    ("observer", "message"),
    [
        ({"kind": "kalmann", "motor": {}}, r"observer.kind: unknown kind 'kalmann'; did you mean 'kalman'"),
        ({"kind": "luenberger", "motor": {"lambda": 1.0}}, r"observer.motor.bandwidth: this key is missing"),
        ({"kind": "luenberger", "motor": {"bandwidth": -1.0}}, r"observer.motor.bandwidth: should be greater than 0"),
        (
            {"kind": "luenberger", "motor": {"bandwith": 1.0}},
            r"observer.motor: unknown key 'bandwith'; did you mean 'bandwidth'",
        ),
        ({"motor": {"bandwidth": 1.0, "alpha": 9.0}}, r"observer.motor.lambda: this key is missing"),
        ({"kind": 3, "motor": {}}, r"observer"),
        (3, r"observer: should be a table"),
    ],
)
def test_wrong_observers_get_one_line(observer, message):
    with pytest.raises(InputError, match=message) as error:
        read_config(small_study() | {"observer": observer})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_every_kind_says_what_a_search_should_try(kind):
    """Gains of the class, positive, and a study with them runs."""
    cls = OBSERVERS[kind].select_discretisation("implicit")
    gain_ranges = cls.gain_ranges(OperatingConditions(f_plus=3.0, period=1e-3, noise=1e-5))
    assert gain_ranges
    assert all(0.0 < least <= largest < np.inf for least, largest in gain_ranges.values())
    middle = {key: (least * largest) ** 0.5 for key, (least, largest) in gain_ranges.items()}
    config = read_config(study(observer={"kind": kind, "motor": middle, "load": middle}))
    paths = [path for path in numeric_paths(config) if path.startswith("observer.motor.")]
    assert {f"observer.motor.{key}" for key in gain_ranges} <= set(paths)
    assert config.build().observer.motor.name == kind
    # gains of other kinds are no numbers of this study
    assert len(paths) == len(list(parameters(cls)))


def test_tune_says_which_observers_it_is_for():
    with pytest.raises(InputError, match=r"observer.kind: tune chooses lambda and alpha of kind 'super_twisting'"):
        jaxbl.tune(study(observer={"kind": "kalman", "motor": GAINS, "load": GAINS}))


def test_gains_of_any_kind_can_be_included(tmp_path):
    """A file of gains alone, as the explorer saves them, under a study that names the kind."""
    (tmp_path / "gains.toml").write_text("[observer.motor]\nbandwidth = 70.0\n[observer.load]\nbandwidth = 80.0\n")
    data = read_config(study(observer={"kind": "extended_state", "motor": GAINS, "load": GAINS})).to_dict()
    data["observer"] = {"kind": "extended_state"}
    (tmp_path / "study.toml").write_text('include = "gains.toml"\n' + tomli_w.dumps(data))
    observer = read_config(tmp_path / "study.toml").build().observer
    assert (observer.motor.gains(), observer.load.gains()) == ({"bandwidth": 70.0}, {"bandwidth": 80.0})
