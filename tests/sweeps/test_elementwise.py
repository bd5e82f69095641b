import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbl.sweeps.elementwise as under_test
from jaxbl.sweeps.elementwise import apply_elementwise


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 3, 4, 7, 24, 25])
def test_columns_of_any_length_by_programs_of_two_shapes(count, dtype, monkeypatch):
    monkeypatch.setattr(under_test, "_PIECE_SIZES", (2, 4))
    shapes = []

    @jax.jit
    def add_and_compare(x, y):
        shapes.append(x.shape)
        return {"sum": x + y, "less": x < y}

    x, y = np.arange(count, dtype=dtype), np.flip(np.arange(count, dtype=dtype))
    result = apply_elementwise(add_and_compare, [x, y])
    np.testing.assert_array_equal(result["sum"], np.full(count, count - 1.0))
    np.testing.assert_array_equal(result["less"], x < y)
    assert result["sum"].dtype == dtype and set(shapes) == {(1, 2 if count <= 4 else 4)}
    shapes.clear()
    np.testing.assert_array_equal(apply_elementwise(add_and_compare, [x, y], largest=5)["sum"], result["sum"])
    # traced already, where there are more than four
    assert set(shapes) == ({(1, 4)} if count <= 4 else set())


def test_devices_share_pieces(monkeypatch):
    monkeypatch.setattr(under_test, "_PIECE_SIZES", (2, 4))
    used, compile_map = [], under_test._map_over_devices

    def program_for(function, devices):
        program, rows = compile_map(function, devices)
        return lambda *pieces: used.append(pieces[0].devices()) or program(*pieces), rows

    monkeypatch.setattr(under_test, "_map_over_devices", program_for)
    devices = jax.local_devices()
    assert len(devices) == 2
    assert apply_elementwise(jnp.sqrt, [np.ones(9)], devices).shape == (9,)
    assert used == [set(devices)] * 2
    assert apply_elementwise(jnp.sqrt, [np.ones(3)], devices[1:]).shape == (3,)
    assert used[2:] == [{devices[1]}]


def test_devices_do_not_wait_for_each_other():
    """Two programs whose loops end together, at the same time, may wait for each other forever."""

    def halve_until_small(x):
        return jax.lax.while_loop(lambda x: jnp.any(x > 1.0), lambda x: jnp.where(x > 1.0, x / 2.0, x), x)

    devices = tuple(jax.local_devices())
    program, rows = under_test._map_over_devices(halve_until_small, devices)
    piece = jax.device_put(np.arange(8.0).reshape(2, 4), rows)
    assert "all-reduce" in jax.jit(halve_until_small).lower(piece).compile().as_text()
    assert "all-reduce" not in program.lower(piece).compile().as_text()
    np.testing.assert_array_equal(program(piece), halve_until_small(np.arange(8.0).reshape(2, 4)))
