"""Units along a line."""

import pytest

from jaxbl.units import on_a_line


@pytest.mark.parametrize(
    ("turning", "linear"),
    [
        ("kg m²", "kg"), ("N m", "N"), ("N m s/rad", "N s/m"), ("N m/rad", "N/m"), ("rad/s²", "m/s²"), ("√rad/s", "√m/s"),
        ("s", "s"), ("", ""),
    ],
)  # fmt: skip
def test_what_stands_for_units_of_turning_parts(turning, linear):
    assert on_a_line(turning) == linear
