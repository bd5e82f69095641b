import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbl.sweeps.pieces as under_test
from jaxbl.sweeps.pieces import in_pieces


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 3, 4, 7, 24, 25])
def test_columns_of_any_length_by_one_program(count, dtype, monkeypatch):
    monkeypatch.setattr(under_test, "_SIZE", 4)
    shapes = []

    @jax.jit
    def both(x, y):
        shapes.append(x.shape)
        return {"sum": x + y, "less": x < y}

    x, y = np.arange(count, dtype=dtype), np.flip(np.arange(count, dtype=dtype))
    found = in_pieces(both, [x, y])
    np.testing.assert_array_equal(found["sum"], np.full(count, count - 1.0))
    np.testing.assert_array_equal(found["less"], x < y)
    assert found["sum"].dtype == dtype and set(shapes) == {(2, 4)}


def test_devices_share_pieces(monkeypatch):
    monkeypatch.setattr(under_test, "_SIZE", 4)
    used = []

    def where(x):
        used.append(x.devices())
        return jnp.sqrt(x)

    devices = jax.local_devices()
    assert len(devices) == 2
    assert in_pieces(where, [np.ones(9)], devices).shape == (9,)
    assert used == [set(devices)] * 2
    assert in_pieces(where, [np.ones(3)], devices[1:]).shape == (3,)
    assert used[2:] == [{devices[1]}]
