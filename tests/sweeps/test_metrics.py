"""The streaming metrics against NumPy on a full trace."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper_drive import paper_experiment

from jaxbl.chain import scan
from jaxbl.control import Cascade, Ramp
from jaxbl.drive import DeadZone, LinearShaft, Rigid, SigmoidBacklash
from jaxbl.errors import InputError
from jaxbl.observer import ExplicitSuperTwisting, ImplicitSuperTwisting, Observers, conditions
from jaxbl.sweeps import metrics as under_test
from jaxbl.sweeps.metrics import (
    ALL_METRICS,
    SIDE_METRICS,
    ObserverGains,
    add_gain_metrics,
    find_metric,
    metric_columns,
    needs_gain_metrics,
    observer_gains,
    window_start,
)

H = 1e-3


@eqx.filter_jit
def scan_signals(experiment):
    figures, selected = scan(experiment, jnp.asarray(2), (ALL_METRICS,), lambda state, signals: (signals, state.identifier))
    return figures, selected


def metrics_by_numpy(experiment, signals, identifier):
    """All columns again, from the whole trace and the last state of the identifier."""
    steps = experiment.run.steps
    late = slice(steps - steps // 4, None)
    time = np.asarray(signals.time)
    expected = {"finite": True}
    for side in experiment.sides:
        s, observer = signals.side(side), getattr(experiment.observer, side)
        ratio = float(experiment.drive.ratio(side))
        position = np.asarray(s.true.position - s.position_estimate)
        velocity = np.asarray(s.true.velocity - s.velocity_estimate)
        torque = np.asarray(signals.torque - s.torque_estimate)
        outside = (np.abs(position) > experiment.run.position_tolerance / ratio) | (
            np.abs(velocity) > experiment.run.velocity_tolerance / ratio
        )
        f_plus = np.abs(s.true.perturbation).max()
        last = np.flatnonzero(outside)[-1] if outside.any() else -1
        out = {
            "converged": not outside[late].any(),
            "convergence_time": time[last + 1] if last + 1 < steps else np.nan,
            "position_rmse": np.sqrt(np.mean(position[late] ** 2)),
            "velocity_rmse": np.sqrt(np.mean(velocity[late] ** 2)),
            "torque_rmse": np.sqrt(np.mean(torque[late] ** 2)),
            "position_size": np.sqrt(np.mean(np.asarray(s.true.position)[late] ** 2)),
            "velocity_size": np.sqrt(np.mean(np.asarray(s.true.velocity)[late] ** 2)),
            "chatter": np.sqrt(np.mean(np.diff(velocity[late.start - 1 :]) ** 2) / 2.0),
            "f_plus": f_plus,
            "f_plus_acceleration": 2.0 * np.abs(s.true.acceleration).max(),
            "margin_alpha": observer.alpha / f_plus,
            "convergence_time_bound": conditions.convergence_time_bound(
                observer.lambda_, observer.alpha, f_plus, np.abs(position[0]), np.abs(velocity[0])
            ),
            "convergence_time_worst": conditions.convergence_time_worst(
                observer.lambda_, observer.alpha, f_plus, observer.position_error, observer.velocity_error
            ),
        }
        for name, (_, least) in conditions.CONDITIONS.items():
            out[f"margin_{name}"] = observer.lambda_ / least(observer.alpha, f_plus)
        if identifier is not None:
            law = experiment.transmission
            information = np.array([float(total.value(identifier.weight)[-1]) for total in identifier.information])
            right = np.array([float(total.value(identifier.weight)[-1]) for total in identifier.right[side]])
            if right.size == 1:
                out["stiffness_error"] = right[0] / information[0] / law.stiffness - 1.0
                out["excitation"] = 1.0
            else:
                matrix = np.array([[information[0], information[1]], [information[1], information[2]]])
                theta = np.linalg.solve(matrix, right)
                out["stiffness_error"] = theta[0] / law.stiffness - 1.0
                amplitude = law.dead_zone if isinstance(law, SigmoidBacklash) else law.half_gap
                out["dead_zone_error"] = theta[1] / theta[0] / amplitude - 1.0
                scale = np.sqrt(np.diag(matrix))
                out["excitation"] = np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0]
        expected |= {f"{side}.{name}": value for name, value in out.items()}
    return expected


CASES = {
    "converges": {"velocity_error": 0.5, "noise": 1e-5},
    "never leaves tolerance": {},
    "never converges": {"noise": 1e-2},
    "explicit, load off": {
        "noise": 1e-5,
        "observer": Observers(
            ExplicitSuperTwisting(4.0, 9.0, position_error=0.02), ExplicitSuperTwisting(0.5, 0.2, velocity_error=-0.05)
        ),
    },
    "linear shaft": {"transmission": LinearShaft(1.2), "velocity_error": 0.2},
    "hard gap": {"transmission": DeadZone(1.2, 1e-4), "velocity_error": 0.2},
    "rigid": {
        "drive": Rigid(0.05, 0.15),
        "transmission": None,
        "identifier": None,
        "observer": Observers(ImplicitSuperTwisting(4.0, 9.0, velocity_error=0.3)),
    },
}


@pytest.mark.parametrize("case", CASES)
def test_columns_against_numpy_on_the_whole_trace(case):
    # steps that no block length and no quarter divides
    experiment = paper_experiment(time_constant=0.01, start=0.3, steps=1023, **CASES[case])
    figures, (signals, identifier) = scan_signals(experiment)
    expected = metrics_by_numpy(experiment, signals, identifier)
    figures = add_gain_metrics(figures, observer_gains(experiment))
    assert set(figures) == set(expected) == set(metric_columns(experiment))
    for name, value in expected.items():
        np.testing.assert_allclose(figures[name], value, rtol=1e-7, atol=1e-12, err_msg=name)
    if case == "converges":
        assert figures["motor.converged"]
        assert 0.0 < figures["motor.convergence_time"] < 0.2
    elif case == "never leaves tolerance":
        assert figures["motor.convergence_time"] == 0.0
    elif case == "never converges":
        assert not figures["motor.converged"]
        assert np.isnan(figures["motor.convergence_time"])
    elif case == "explicit, load off":
        assert figures["motor.convergence_time"] > 0.0
        assert figures["load.convergence_time"] > 0.0


def test_converged_needs_the_whole_last_quarter():
    """A tolerance that the velocity error leaves for the last time within the last quarter."""
    experiment = paper_experiment(time_constant=0.01, start=0.3, steps=1023, noise=1e-4)
    _, (signals, _) = scan_signals(experiment)
    error = np.abs(np.asarray(signals.motor.true.velocity - signals.motor.velocity_estimate))
    peak = 768 + int(np.argmax(error[768:]))
    for factor, converged in ((0.999, False), (1.001, True)):
        tight = eqx.tree_at(lambda e: e.run.velocity_tolerance, experiment, jnp.asarray(factor * error[peak]))
        figures, _ = scan_signals(tight)
        assert figures["motor.converged"] == converged


@pytest.mark.parametrize(("steps", "first"), [(1, 0), (3, 2), (4, 3), (1023, 768), (20_000, 15_000)])
def test_last_quarter(steps, first):
    assert window_start(steps) == first


def test_every_column_has_unit_and_meaning():
    controlled = paper_experiment(controller=Cascade(1.0, 1.0), reference=Ramp(0.0))
    columns = metric_columns(controlled)
    assert len(columns) == 1 + 2 * len(SIDE_METRICS)
    # in open loop nothing follows
    assert set(columns) - set(metric_columns(paper_experiment())) == {
        f"{side}.{name}" for side in ("motor", "load") for name, metric in SIDE_METRICS.items() if metric.closed_loop
    }
    for column in columns:
        assert find_metric(column).doc
    assert find_metric("load.torque_rmse").unit == "N m"


def test_some_metrics_alone():
    experiment = paper_experiment()
    assert metric_columns(experiment, ["f_plus", "converged"]) == [
        "finite", "motor.converged", "motor.f_plus", "load.converged", "load.f_plus",
    ]  # fmt: skip
    reducer = under_test.metrics_reducer(("converged", "convergence_time"))
    assert reducer is under_test.metrics_reducer(("converged", "convergence_time"))
    assert reducer != under_test.metrics_reducer(("converged",))
    # one state for both, besides those that show whether the lane stays finite
    assert {side: len(carry) for side, carry in reducer.init(experiment).items()} == {"motor": 6, "load": 6}
    assert [needs_gain_metrics(names) for names in (None, ("converged",), ("margin_alpha",))] == [True, False, True]
    shapes = jax.eval_shape(lambda: scan(experiment, jnp.asarray(2), (under_test.metrics_reducer(("margin_alpha",)),))[0])
    assert set(shapes) == {"finite", "motor.f_plus", "load.f_plus"}


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ["converged", "velocity_rms"],
            r"^sweep.metrics\[1\]: 'velocity_rms' is no metric; did you mean 'velocity_rmse'\?$",
        ),
        (["motor.converged"], r"did you mean 'converged'\?$"),
        (["stiffness_error"], r"^sweep.metrics\[0\]: 'stiffness_error' does not apply to this study; "),
    ],
)
def test_metrics_that_cannot_be_had(names, message):
    rigid = paper_experiment(**CASES["rigid"])
    with pytest.raises(InputError, match=message):
        metric_columns(rigid, names)


def test_conditions_are_computed_once_for_lanes_that_share_them(monkeypatch):
    counts = []
    apply_elementwise = under_test.apply_elementwise

    def count_pieces(function, columns, **keys):
        counts.append((len(columns[0]), keys))
        return apply_elementwise(function, columns, **keys)

    monkeypatch.setattr(under_test, "apply_elementwise", count_pieces)
    # two seeds of three lanes: the load's gains and f_plus are the same for all lanes of a seed
    f_plus = {
        "motor.f_plus": np.array([[1.0, 2.0, 3.0], [1.0, 2.5, np.nan]]),
        "load.f_plus": np.array([[0.1] * 3, [0.2] * 3]),
    }
    gains = {
        "motor": ObserverGains(np.array([4.0, 5.0, 6.0]), np.array([9.0, 9.0, 8.0]), np.array(0.0), np.array(0.5)),
        "load": ObserverGains(*map(np.array, (0.5, 0.4, 0.0, 0.1))),
    }
    result = add_gain_metrics(f_plus, gains)
    # both sides by the program of six lanes
    assert counts == [(5, {"largest": 6}), (2, {"largest": 6})]
    for seed, lane in np.ndindex(2, 3):
        lane_f_plus = {name: np.asarray(values[seed, lane]) for name, values in f_plus.items()}
        lane_gains = {
            side: ObserverGains(*(gain if gain.ndim == 0 else gain[lane] for gain in g)) for side, g in gains.items()
        }
        for name, value in add_gain_metrics(lane_f_plus, lane_gains).items():
            np.testing.assert_array_equal(result[name][seed, lane], value, err_msg=name)
