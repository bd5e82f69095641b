import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbl.sweeps.pieces as under_test
from jaxbl.sweeps.pieces import in_pieces


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 3, 4, 7, 24, 25])
def test_columns_of_any_length_by_programs_of_two_shapes(count, dtype, monkeypatch):
    monkeypatch.setattr(under_test, "_SIZES", (2, 4))
    shapes = []

    @jax.jit
    def both(x, y):
        shapes.append(x.shape)
        return {"sum": x + y, "less": x < y}

    x, y = np.arange(count, dtype=dtype), np.flip(np.arange(count, dtype=dtype))
    found = in_pieces(both, [x, y])
    np.testing.assert_array_equal(found["sum"], np.full(count, count - 1.0))
    np.testing.assert_array_equal(found["less"], x < y)
    assert found["sum"].dtype == dtype and set(shapes) == {(1, 2 if count <= 4 else 4)}
    shapes.clear()
    np.testing.assert_array_equal(in_pieces(both, [x, y], most=5)["sum"], found["sum"])
    # traced already, where there are more than four
    assert set(shapes) == ({(1, 4)} if count <= 4 else set())


def test_devices_share_pieces(monkeypatch):
    monkeypatch.setattr(under_test, "_SIZES", (2, 4))
    used, made = [], under_test._program

    def program_for(function, devices):
        program, rows = made(function, devices)
        return lambda *pieces: used.append(pieces[0].devices()) or program(*pieces), rows

    monkeypatch.setattr(under_test, "_program", program_for)
    devices = jax.local_devices()
    assert len(devices) == 2
    assert in_pieces(jnp.sqrt, [np.ones(9)], devices).shape == (9,)
    assert used == [set(devices)] * 2
    assert in_pieces(jnp.sqrt, [np.ones(3)], devices[1:]).shape == (3,)
    assert used[2:] == [{devices[1]}]


def test_devices_do_not_wait_for_each_other():
    """Two programs whose loops end together, at the same time, may wait for each other forever."""

    def halved(x):
        return jax.lax.while_loop(lambda x: jnp.any(x > 1.0), lambda x: jnp.where(x > 1.0, x / 2.0, x), x)

    devices = tuple(jax.local_devices())
    program, rows = under_test._program(halved, devices)
    piece = jax.device_put(np.arange(8.0).reshape(2, 4), rows)
    assert "all-reduce" in jax.jit(halved).lower(piece).compile().as_text()
    assert "all-reduce" not in program.lower(piece).compile().as_text()
    np.testing.assert_array_equal(program(piece), halved(np.arange(8.0).reshape(2, 4)))
