"""Units of what turns, and of what moves along a line."""

_LINEAR = (("kg m²", "kg"), ("N m", "N"), ("rad", "m"))


def on_a_line(unit: str) -> str:
    """The unit that stands for one of a turning part (rad, N m, kg m², ...) where the part moves in m."""
    for turning, linear in _LINEAR:
        unit = unit.replace(turning, linear)
    return unit
