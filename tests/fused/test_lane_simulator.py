"""The fused loop does what the scan does: all laws, effects and observers, both precisions."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effect_values import ENCODERS, VALUES
from jax.extend.core import jaxpr_as_fun
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from jaxbl.chain import Experiment, Reducer, Run, scan
from jaxbl.drive import Encoders, Initial, LinearShaft, Rigid, TwoInertia, as_arrays, get_leaf, set_leaves
from jaxbl.drive.effects import make_effect
from jaxbl.drive.excitation import Chirp, Sine
from jaxbl.drive.parameters import leaf_paths
from jaxbl.drive.transmission import DeadZone
from jaxbl.fused import Unsupported, lane_simulator as module
from jaxbl.fused.jaxprs import join_multiply_add, replace_primitives
from jaxbl.fused.lane_simulator import DeviceSimulator, HostSimulator, LaneSimulator
from jaxbl.fused.pallas import LANES, Kernel
from jaxbl.fused.shared_part import SharedPartLoop
from jaxbl.observer import DISCRETISATIONS, EquivalentControl, Identifier, Observers
from jaxbl.sweeps.metrics import ALL_METRICS, metrics_reducer
from jaxbl.throughput.workload import CHAIN_METRICS, RANGES, SEED, Workload

HALF_OF_EFFECTS = [
    "motor.coulomb_friction", "load.stribeck_friction", "load.gravity", "motor.cogging", "load.periodic_disturbance",
    "transmission.damping", "actuator.lag", "actuator.saturation",
]  # fmt: skip
OTHER_HALF = [*(name for name in VALUES if name not in HALF_OF_EFFECTS), *ENCODERS]


def make_experiment(names, law=None, observer="implicit", rigid=False, substeps=2, steps=701, precision="float64"):
    kind = DISCRETISATIONS[observer]
    motor = kind(10.0, 90.0, velocity_error=0.5)
    return as_arrays(
        Experiment(
            drive=Rigid(0.02, 0.03) if rigid else TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0),
            transmission=law,
            effects=tuple(make_effect(name, **(VALUES | ENCODERS)[name]) for name in names),
            initial=Initial(),
            excitation=Chirp(5.0, 0.5, 3.0, 0.5) if rigid else Sine(5.0, 0.8),
            encoders=Encoders(1e-4, motor_resolution=1e-5),
            observer=Observers(motor) if rigid else Observers(motor, kind(2.5, 8.2)),
            equivalent_control=EquivalentControl(0.01),
            identifier=None if rigid else Identifier(0.1),
            run=Run(1e-3, steps, substeps),
        ),
        np.dtype(precision),
    )


def spread_lane_values(experiment, paths, lanes):
    """Numbers of so many lanes about those of the experiment."""
    return {path: np.asarray(get_leaf(experiment, path)) * np.linspace(0.6, 1.4, lanes) for path in paths}


def scan_lanes(experiment, values, reducer, seed):
    """Figures of the scan."""

    def scan_lane(values):
        return scan(set_leaves(experiment, values), jnp.asarray(seed), (reducer,))[0]

    return jax.jit(jax.vmap(scan_lane))(values)


class Parts(LaneSimulator):
    """Parts of the loop or of the kernel, not compiled."""

    def _simulate(self, values, spans):
        raise NotImplementedError


@functools.cache
def make_parts(half, precision):
    """Parts of a short run with half of the effects, and with all metrics or one."""
    names, law, metric_names = (
        (HALF_OF_EFFECTS, DeadZone(60.0, 0.05), None) if half else (OTHER_HALF, LinearShaft(60.0), ("torque_rmse",))
    )
    full_experiment = make_experiment(names, law, steps=200, precision=precision)
    return Parts(
        full_experiment,
        (metrics_reducer(metric_names),),
        tuple(path for path in leaf_paths(full_experiment) if path.startswith("effects.")),
        5,
    )


@pytest.mark.parametrize(
    ("names", "law", "options"),
    [
        (HALF_OF_EFFECTS, DeadZone(60.0, 0.05), {}),
        (OTHER_HALF, LinearShaft(60.0), {"observer": "explicit", "substeps": 1}),
        (OTHER_HALF[:2], LinearShaft(60.0), {"missed": 0.1}),
    ],
    ids=["half", "others", "missed"],
)
def test_figures_are_those_of_the_scan(names, law, options):
    """Threads get different numbers of lanes."""
    missed = options.get("missed")
    full_experiment = make_experiment(names, law, **{key: value for key, value in options.items() if key != "missed"})
    encoders = dataclasses.replace(full_experiment.encoders, missed=missed and jnp.asarray(missed))
    full_experiment = dataclasses.replace(full_experiment, encoders=encoders)
    effects = [path for path in leaf_paths(full_experiment) if path.startswith("effects.")]
    values = spread_lane_values(full_experiment, [*effects, "observer.motor.alpha", "encoders.noise"], 150)
    fused = HostSimulator(full_experiment, (ALL_METRICS,), tuple(values), 150, 2)(values, 3)
    expected = scan_lanes(full_experiment, values, ALL_METRICS, 3)
    assert set(fused) == set(expected)
    for name, figure in fused.items():
        # where readings are missed, less information is left, and rounding weighs more
        np.testing.assert_allclose(figure, expected[name], rtol=1e-6 if missed else 1e-7, err_msg=name)


def test_figures_of_one_inertia_are_those_of_the_scan_and_of_the_kernel_of_accelerators():
    """The kernel, interpreted: two programs of the grid, the last lanes filled up, blocks of samples with a rest."""
    full_experiment = make_experiment(["motor.coulomb_friction", "load.gravity"], rigid=True, substeps=3)
    values = spread_lane_values(
        full_experiment, ["effects.motor.coulomb_friction.torque", "observer.motor.alpha", "encoders.noise"], 150
    )
    fused = HostSimulator(full_experiment, (ALL_METRICS,), tuple(values), 150, 2)(values, 3)
    expected = scan_lanes(full_experiment, values, ALL_METRICS, 3)
    device = DeviceSimulator(full_experiment, (ALL_METRICS,), tuple(values), 150, interpret=True)(values, 3)
    assert set(fused) == set(device) == set(expected)
    for name, figure in fused.items():
        np.testing.assert_allclose(figure, expected[name], rtol=1e-7, err_msg=name)
        assert device[name].dtype == figure.dtype
        np.testing.assert_allclose(device[name], figure, rtol=1e-6, err_msg=name)


def test_a_figure_computed_alone_is_to_the_bit_what_it_is_beside_the_others():
    full_experiment = make_experiment(["motor.coulomb_friction", "load.gravity", "actuator.lag"], DeadZone(60.0, 0.05))
    values = spread_lane_values(
        full_experiment, [path for path in leaf_paths(full_experiment) if path.startswith("effects.")], 37
    )
    reducers = ALL_METRICS, metrics_reducer(("chatter", "f_plus", "torque_rmse"))
    all_metrics, some_metrics = (
        HostSimulator(full_experiment, (reducer,), tuple(values), 37, 2)(values, 3) for reducer in reducers
    )
    assert len(some_metrics) < len(all_metrics)
    for name, figure in some_metrics.items():
        np.testing.assert_array_equal(figure, all_metrics[name], err_msg=name)


def test_what_no_axis_touches_is_computed_once():
    """Axes on gains alone leave the plant to the shared part: no law is evaluated in a lane."""
    full_experiment = make_experiment([], DeadZone(60.0, 0.05))
    values = spread_lane_values(full_experiment, ["observer.motor.alpha", "observer.motor.lambda"], 7)
    simulator = HostSimulator(full_experiment, (ALL_METRICS,), tuple(values), 7, 1)
    varied_parts = Parts(full_experiment, (ALL_METRICS,), ("transmission.half_gap",), 7)
    assert simulator.carry_count < varied_parts.carry_count
    # the plant's states are stepped by a loop of scalars, ahead of the lanes
    assert isinstance(simulator._run_shared_part, SharedPartLoop)
    assert simulator._run_shared_part._loop is not None
    expected = scan_lanes(full_experiment, values, ALL_METRICS, 3)
    for name, figure in simulator(values, 3).items():
        np.testing.assert_allclose(figure, expected[name], rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_benchmarks_work_in_both_precisions(precision):
    work = Workload(40, 1500, precision)
    values = work.values()
    with jax.enable_x64(precision == "float64"):
        full_experiment = work.experiment()
        fused = HostSimulator(full_experiment, (CHAIN_METRICS,), tuple(RANGES), work.lanes, 2)(values, SEED)
        expected = scan_lanes(full_experiment, values, CHAIN_METRICS, SEED)
    for name, figure in fused.items():
        assert figure.dtype == precision
        if precision == "float64":
            np.testing.assert_allclose(figure, expected[name], rtol=1e-6)
        elif "rmse" in name:
            # a switching term makes an error of rounding one of a sample
            deviation = np.abs(figure / np.asarray(expected[name]) - 1.0)
            assert np.median(deviation) < 1e-3


def test_the_kernel_of_accelerators_in_single_precision():
    work = Workload(150, 263, "float32")
    with jax.enable_x64(False):
        full_experiment = work.experiment()
        simulators = [
            HostSimulator(full_experiment, (ALL_METRICS,), tuple(RANGES), work.lanes, 1),
            DeviceSimulator(full_experiment, (ALL_METRICS,), tuple(RANGES), work.lanes, interpret=True),
        ]
        host, device = (simulator(work.values(), SEED) for simulator in simulators)
    for name, figure in device.items():
        assert figure.dtype in (np.float32, bool)
        if name.endswith("_rmse"):
            assert np.median(np.abs(figure / host[name] - 1.0)) < 1e-3, name


@pytest.mark.parametrize(
    ("half", "precision"), [(True, "float64"), (False, "float32")], ids=["half, float64", "others, float32"]
)
@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_the_kernel_can_be_written_for_a_gpu(half, precision):
    """No GPU is needed for that: every operation is one that Triton knows, products are joined with sums."""
    with jax.enable_x64(precision == "float64"):
        result = make_parts(half, precision)
        kernel = Kernel(result._step, result._hooks, len(result._paths), 2 * LANES, 200, 64)
        # from JAX 0.11 on it has to be told which GPU
        device = AbstractDevice("NVIDIA H100", None, "gpu")
        with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
            written = jax.jit(kernel.run).trace(*kernel.arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert "fma.rn" in written


@pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="that only a processor lacks a kernel: this device may compile one"
)
def test_a_processor_has_no_kernel_of_accelerators():
    with pytest.raises(Unsupported, match="compilation for this device"):
        DeviceSimulator(make_experiment([], LinearShaft(60.0)), (ALL_METRICS,), ("transmission.stiffness",), 5)


def test_what_is_joined_for_a_gpu_computes_the_same():
    result, joined_terms = make_parts(True, "float64"), []

    def multiply_add(a, b, c, *, minus_product, minus_rest):
        joined_terms.append(a)
        return (-a if minus_product else a) * b + (-c if minus_rest else c)

    random = np.random.default_rng(1)
    for part in (result._step, *result._hooks):
        dtypes = [random.uniform(0.5, 1.5, aval.shape).astype(aval.dtype) for aval in part.in_avals]
        other = join_multiply_add(replace_primitives(part, {}), multiply_add)
        pairs = jax.jit(lambda *x, jaxprs=(other, part): [jaxpr_as_fun(jaxpr)(*x) for jaxpr in jaxprs])(*dtypes)
        for pair, expected in zip(*pairs, strict=True):
            np.testing.assert_allclose(pair, expected, rtol=1e-12)
    assert len(joined_terms) > 50


def test_values_of_another_number_of_lanes_are_refused():
    work = Workload(40, 70, "float64")
    simulator = HostSimulator(work.experiment(), (CHAIN_METRICS,), tuple(RANGES), work.lanes, 2)
    with pytest.raises(ValueError, match=r"encoders\.noise: 40 lanes need as many values, not an array of shape \(3,\)"):
        simulator(work.values() | {"encoders.noise": np.ones(3)}, SEED)


def test_an_error_of_a_thread_reaches_the_caller(monkeypatch):
    work = Workload(4000, 3000, "float64")
    simulator = HostSimulator(work.experiment(), (CHAIN_METRICS,), tuple(RANGES), work.lanes, 2)
    loop, calls = simulator._loop, []

    def fail_third_call(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise MemoryError("no more")
        loop(*arguments, **options)

    fail_third_call.signature, fail_third_call.lanes = loop.signature, loop.lanes
    monkeypatch.setattr(simulator, "_loop", fail_third_call)
    with pytest.raises(MemoryError, match="no more"):
        simulator(work.values(), SEED)
    monkeypatch.undo()
    assert np.isfinite(simulator(work.values(), SEED)["motor.velocity_rmse"]).all()


@pytest.mark.parametrize(("precision", "threads"), [("float32", 2), ("float64", 1)])
def test_lanes_that_are_done_leave_and_nothing_else_changes(monkeypatch, precision, threads):
    """Lanes with a shaft too stiff for the plant's step overflow, some at once, some later, some on one side alone; one
    after the other, and mixed."""
    monkeypatch.setattr(module, "_CALL_WORK", 1)
    monkeypatch.setattr(module, "_THREAD_WORK", 1)
    lanes, samples = 300, []
    stiffness = np.concatenate([np.full(100, 60.0), np.geomspace(1e5, 1e7, 200)])
    orders = np.arange(lanes), np.random.default_rng(0).permutation(lanes)
    with jax.enable_x64(precision == "float64"):
        full_experiment = make_experiment([], LinearShaft(60.0), substeps=1, steps=64 * 41, precision=precision)
        values = {"transmission.stiffness": stiffness}
        staying = ALL_METRICS._replace(done=None)
        expected = HostSimulator(full_experiment, (staying,), tuple(values), lanes, 1)(values, 3)
        assert 0 < np.count_nonzero(expected["finite"]) < lanes
        simulator = HostSimulator(full_experiment, (ALL_METRICS,), tuple(values), lanes, threads)
        assert len(simulator._pools) == threads
        loop = simulator._loop

        def count_samples(arrays, end, loop=loop, **options):
            samples.append((end - options.get("start", 0)) * arrays.lanes)
            loop(arrays, end, **options)

        count_samples.signature, count_samples.lanes = loop.signature, loop.lanes
        count_samples.whole_vectors = loop.whole_vectors
        monkeypatch.setattr(simulator, "_loop", count_samples)
        for order in orders:
            samples.clear()
            actual = simulator({"transmission.stiffness": stiffness[order]}, 3)
            assert set(actual) == set(expected)
            for name, figure in actual.items():
                assert figure.dtype == expected[name].dtype
                np.testing.assert_array_equal(figure, expected[name][order], err_msg=name)
            # some two thirds of the lanes leave; the last of a thread's vectors need not be full
            assert sum(samples) < (0.6 * lanes + threads * loop.lanes) * full_experiment.run.steps


@pytest.mark.parametrize(("precision", "threads"), [("float32", 1), ("float64", 2)])
def test_lanes_whose_answer_is_known_leave(monkeypatch, precision, threads):
    """Some keep the tolerance, some never do, and of both some overflow, early or in the last quarter."""
    monkeypatch.setattr(module, "_CALL_WORK", 1)
    monkeypatch.setattr(module, "_THREAD_WORK", 1)
    lanes, samples = 256, []
    # about the stiffness from which float32 and float64 overflow within the run
    overflowing = np.linspace(1.6965e5, 1.698e5, 64), np.linspace(1.703e5, 1.713e5, 64)
    stiffness = np.concatenate([np.full(64, 60.0), *overflowing, np.full(64, 1e6)])
    tolerance = np.where(np.arange(lanes) % 4 == 0, 1e3, 1e-12)
    with jax.enable_x64(precision == "float64"):
        full_experiment = make_experiment([], LinearShaft(60.0), substeps=1, steps=64 * 41, precision=precision)
        values = {"transmission.stiffness": stiffness, "run.velocity_tolerance": tolerance}
        values["run.position_tolerance"] = np.where(tolerance > 1.0, 1e3, 1e-12)
        convergence_reducer = metrics_reducer(("converged", "convergence_time"))
        full_simulator, staying_simulator = (
            HostSimulator(full_experiment, (reducer,), tuple(values), lanes, 1)
            for reducer in (ALL_METRICS, convergence_reducer._replace(done=None))
        )
        assert staying_simulator.carry_count < full_simulator.carry_count
        expected, staying_metrics = full_simulator(values, 3), staying_simulator(values, 3)
        assert 0 < np.count_nonzero(expected["motor.converged"]) < lanes
        assert set(staying_metrics) < set(expected)
        # a side is not followed once its answer is known: what overflows later is not seen
        assert (staying_metrics["finite"] >= expected["finite"]).all()
        assert np.count_nonzero(staying_metrics["finite"]) > np.count_nonzero(expected["finite"])
        simulator = HostSimulator(full_experiment, (convergence_reducer,), tuple(values), lanes, threads)
        loop = simulator._loop

        def count_samples(arrays, end, loop=loop, **options):
            if end > options.get("start", 0):
                samples.append(arrays.lanes)
            loop(arrays, end, **options)

        count_samples.signature, count_samples.lanes = loop.signature, loop.lanes
        count_samples.whole_vectors = loop.whole_vectors
        monkeypatch.setattr(simulator, "_loop", count_samples)
        samples.clear()
        actual = simulator(values, 3)
        # in the last block, those are left that keep the tolerance
        assert samples[-1] < lanes // 4
        assert set(actual) == set(staying_metrics)
        for name, figure in actual.items():
            np.testing.assert_array_equal(figure, staying_metrics[name], err_msg=name)
            if name != "finite":
                np.testing.assert_array_equal(figure, expected[name], err_msg=name)


def test_all_lanes_may_leave(monkeypatch):
    monkeypatch.setattr(module, "_CALL_WORK", 1)
    full_experiment = make_experiment([], LinearShaft(60.0), substeps=1, steps=64 * 41)
    simulator = HostSimulator(full_experiment, (ALL_METRICS,), ("transmission.stiffness",), 5, 1)
    result = simulator({"transmission.stiffness": np.full(5, 1e8)}, 3)
    assert not result["finite"].any()
    assert not result["load.converged"].any()
    assert np.isnan(result["load.velocity_rmse"]).all()


def test_what_lanes_share_is_kept_for_the_same_seeds_alone(monkeypatch):
    work = Workload(40, 300, "float64")
    simulator = HostSimulator(work.experiment(), (CHAIN_METRICS,), tuple(RANGES), work.lanes, 2)
    drawn_seeds = []
    run_shared_part = simulator._run_shared_part
    monkeypatch.setattr(
        simulator,
        "_run_shared_part",
        lambda state, seed, *remainder: drawn_seeds.append(seed) or run_shared_part(state, seed, *remainder),
    )
    first = simulator(work.values(), 1)
    for seed in (1, 2, 1):
        metrics = simulator(work.values(), seed)
    assert drawn_seeds == [1, 2]
    for name, figure in first.items():
        np.testing.assert_array_equal(metrics[name], figure)
    simulator.keep_seeds([2])
    for seed in (2, 1):
        simulator(work.values(), seed)
    assert drawn_seeds == [1, 2, 1]
    # no room
    monkeypatch.setattr(module, "_CACHE_BYTES", 100)
    simulator.keep_seeds([])
    for seed in (2, 2):
        simulator(work.values(), seed)
    assert drawn_seeds == [1, 2, 1, 2, 2]


def test_an_unknown_operation_is_refused_by_name():
    full_experiment = make_experiment([], DeadZone(60.0, 0.05), steps=100)
    unknown_reducer = Reducer(
        lambda e: jnp.zeros_like(e.run.sample_period),
        lambda e, total, index, signals: total + jax.scipy.special.erf(signals.motor.measured),
        lambda e, total, state: {"odd": total},
    )
    with pytest.raises(Unsupported, match="erf"):
        HostSimulator(full_experiment, (unknown_reducer,), ("transmission.half_gap",), 9, 1)
    truth = Reducer(
        lambda e: jnp.asarray(False),
        lambda e, total, index, signals: total | (signals.motor.measured > 1.0),
        lambda e, total, state: {"truth": total},
    )
    with pytest.raises(Unsupported, match="carry other numbers"):
        HostSimulator(full_experiment, (truth,), ("transmission.half_gap",), 9, 1)
