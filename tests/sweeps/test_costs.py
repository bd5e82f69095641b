"""What a study will take: counted in its traced step, times what the machine takes, which is measured once."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, NOISE, small_study

import jaxbl.sweeps.costs as under_test
from jaxbl.config import read_config
from jaxbl.fused import program_cache
from jaxbl.sweeps.costs import Cost, Costs, Operations, count_operations, load_costs, measure_costs
from jaxbl.sweeps.programs import BACKENDS, Layout, can_run_fused

MADE_UP_COSTS = Costs(Cost(4e-7, 3e-9, 2e-11, 3e-4), Cost(0.0, 5e-9, 7e-11, 2e-3), 1e6)


def test_counted_work():
    one_step, ten_steps = (read_config(small_study({"run.substeps": n})) for n in (1, 10))
    gains, plants = [LAMBDA, ALPHA], ["transmission.dead_zone"]
    gain_operations, plant_operations = count_operations(ten_steps, gains), count_operations(ten_steps, plants)
    # one and the same step, by all lanes or by each
    assert gain_operations.shared + gain_operations.lane == pytest.approx(
        plant_operations.shared + plant_operations.lane, rel=0.1
    )
    assert gain_operations.shared > 3.0 * gain_operations.lane
    assert plant_operations.lane > plant_operations.shared
    # nine plant steps more, each of them a tanh at least
    for paths, field in ((gains, "shared"), (plants, "lane")):
        extra = getattr(count_operations(ten_steps, paths), field) - getattr(count_operations(one_step, paths), field)
        assert 9 * 30 < extra < 9 * 100
    # position and velocity of both sides are among what a lane of its own carries
    assert plant_operations.carried - gain_operations.carried >= 4 * 8
    single_precision = read_config(small_study({"run.precision": "float32"}))
    assert count_operations(single_precision, gains).carried == pytest.approx(
        count_operations(one_step, gains).carried / 2, rel=0.01
    )
    # a run that is twice as long does not more a sample
    long_run = read_config(small_study({"run.duration": 2.0 * one_step.run.duration, "run.substeps": 1}))
    assert count_operations(long_run, [NOISE]).lane == pytest.approx(count_operations(one_step, [NOISE]).lane, rel=0.02)


def test_measured_costs_are_those_of_the_machine(monkeypatch):
    """The machine is made up, and its times follow from its costs."""

    def time_programs(config, devices, cases):
        seconds = {}
        for backend, path, lanes in cases:
            operations = count_operations(config, [path])
            seconds[backend, path, lanes] = MADE_UP_COSTS.sample_seconds(backend, operations, Layout(1, lanes))
            if backend == "scan" and lanes > 10_000:
                # the cache is too small
                seconds[backend, path, lanes] *= 2.0
        equations = count_operations(config, [cases[0][1]]).equations
        return seconds, {"fused": MADE_UP_COSTS.fused.equation * equations, "scan": MADE_UP_COSTS.scan.equation * equations}

    monkeypatch.setattr(under_test, "_time_programs", time_programs)
    costs = measure_costs(jax.devices()[:1])
    for backend in ("fused", "scan"):
        np.testing.assert_allclose(costs.of(backend), MADE_UP_COSTS.of(backend), rtol=1e-6)
    assert costs.cache == 4096 * count_operations(read_config(under_test._STUDY), ["observer.motor.lambda"]).carried


def test_measured_once_where_programs_are_kept(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(under_test, "measure_costs", lambda devices: calls.append(devices) or MADE_UP_COSTS)
    devices = jax.devices()
    assert under_test.load_costs(devices) == under_test._CPU
    assert not calls
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path))
    assert [under_test.load_costs(devices) for _ in range(2)] == [MADE_UP_COSTS, MADE_UP_COSTS]
    assert calls == [devices]


def test_the_backend_that_takes_less_time():
    def choose(platform, layout, samples=10**7, programs=1):
        costs = load_costs([SimpleNamespace(platform=platform)])
        work = Operations(300.0, 100.0, 200.0, 800), Layout(*layout), samples, programs
        return min(BACKENDS, key=lambda backend: costs.study_seconds(backend, *work))

    assert choose("cpu", (1, 3)) == "fused"
    # seed after seed would pay for each what lanes share
    assert choose("cpu", (1000, 3)) == "scan"
    # but XLA takes longer to compile
    assert choose("cpu", (1000, 3), 1000) == "fused"
    assert choose("cpu", (1000, 3), programs=100_000) == "fused"
    # the scan starts kernels for each time step
    assert (choose("gpu", (1, 3)), choose("gpu", (1000, 3))) == ("fused", "scan")
    # several GPUs share lanes by it alone
    devices = ("cpu", 1), ("cpu", 2), ("gpu", 1), ("gpu", 2), ("tpu", 1)
    assert [can_run_fused([SimpleNamespace(platform=platform)] * count) for platform, count in devices] == [
        True, True, True, False, False,
    ]  # fmt: skip
