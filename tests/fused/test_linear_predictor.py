"""The recursion of a predictor's errors by machine code does what its definition says."""

import inspect

import numpy as np
import pytest

from jaxbl.fused import linear_predictor, signal_scan
from jaxbl.fused.compiled_loop import ScannedLoop
from jaxbl.fused.linear_predictor import LinearPredictor


@pytest.mark.parametrize("machine_code", [True, False])
@pytest.mark.parametrize(("states", "sides", "width"), [(2, 1, 3), (5, 2, 40)])
def test_errors_follow_the_definition(states, sides, width, machine_code, monkeypatch):
    rng = np.random.default_rng(1)
    step = 0.3 * rng.normal(size=(60, states, states))
    inputs, readings = rng.normal(size=(states, 60, width)), rng.normal(size=(60, sides))
    start, gains = rng.normal(size=(states, width)), [rng.normal(0.3, 0.1, (sides, 2)) for _ in range(3)]
    recursion = LinearPredictor(states, sides, width)
    if not machine_code:
        define = inspect.unwrap(signal_scan.compile_signal_loop)

        def scanned_loop(*sizes):
            return ScannedLoop(*define(*sizes)[:2])

        monkeypatch.setattr(linear_predictor, "compile_signal_loop", scanned_loop)
    # in two parts
    ends, first = recursion([start] * 3, gains, step[:25], inputs[:, :25], readings[:25])
    ends, last = recursion(ends, gains, step[25:], inputs[:, 25:], readings[25:])
    for gain, end, *parts in zip(gains, ends, first, last, strict=True):
        errors, change = np.concatenate(parts, axis=1), start
        full = np.zeros((states, sides))
        for i in range(sides):
            full[i, i], full[sides + i, i] = gain[i]
        for i in range(60):
            measured = np.zeros((sides, width))
            measured[:, 0] = readings[i]
            residual = measured - change[:sides]
            assert errors[:, i] == pytest.approx(residual, rel=1e-9, abs=1e-12)
            change = step[i] @ (change + full @ residual) + inputs[:, i]
        assert end == pytest.approx(change, rel=1e-9, abs=1e-12)


def test_one_loop_serves_all_widths():
    before = signal_scan.compile_signal_loop.cache_info().misses
    for width in (3, 17, 90):
        LinearPredictor(3, 1, width)(
            [np.zeros((3, width))], [np.zeros((1, 2))], np.zeros((5, 3, 3)), np.zeros((3, 5, width)), np.zeros((5, 1))
        )
    assert signal_scan.compile_signal_loop.cache_info().misses <= before + 1


def test_what_has_decayed_is_zero():
    """Numbers of less than the smallest normal one would take many times as long."""
    count = 3000
    step, inputs = np.tile(0.5 * np.eye(2), (count, 1, 1)), np.zeros((2, count, 3))
    (end,), (errors,) = LinearPredictor(2, 1, 3)([np.ones((2, 3))], [np.zeros((1, 2))], step, inputs, np.zeros((count, 1)))
    assert not end.any()
    small = np.abs(errors[errors != 0.0])
    assert 1e-80 < np.min(small) < 1e-50
    # until then every digit is there
    assert errors[0, :100, 0] == pytest.approx(-(0.5 ** np.arange(100)), rel=1e-15)
