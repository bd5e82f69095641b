"""A number with its uncertainty and unit: as text, in JSON and in tables; and no second place that makes its entry."""

import ast
import json
import math
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

import jaxbl
from jaxbl.files import to_jsonable
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.report.numbers import number_table

PACKAGE = Path(jaxbl.__file__).parent
NUMBERS = st.floats(-1e12, 1e12)


@pytest.mark.parametrize(
    ("value", "error", "unit", "text"),
    [
        (0.38512, 0.0043, "rad", "0.385 ± 0.004 rad"),
        (0.38012, 0.0043, "rad", "0.380 ± 0.004 rad"),
        # an error that begins with 1 has two digits
        (0.274, 0.00149, "N m", "0.2740 ± 0.0015 N m"),
        (-1234.6, 52.0, None, "-1230 ± 50"),
        (1234.6, 5.2, "", "1235 ± 5"),
        (2.31e-5, 5e-6, "kg m²", "2.31e-05 ± 5e-06 kg m²"),
        # a number that is smaller than its error, and none
        (0.0012, 0.5, "s", "0.0 ± 0.5 s"),
        (0.0, 0.02, "m", "0.00 ± 0.02 m"),
        # one that was not estimated, and one that is not known
        (6.0, 0.0, "", "6"),
        (1.5, math.nan, "N", "1.5 N"),
        (math.nan, 0.1, "N", "nan N"),
        # very small and very large ones
        (2.3456789e-9, 5.1e-11, "s", "2.3457e-09 ± 5.1e-11 s"),
        (2.3456789e12, 5.1e9, "N m/rad", "2.3457e+12 ± 5.1e+09 N m/rad"),
    ],
)
def test_text_has_the_digits_that_the_error_leaves(value, error, unit, text):
    assert str(Quantity(value, error, unit=unit)) == text


def test_a_number_of_a_fit_that_is_rejected_has_no_error_beside_it():
    assert str(Quantity(0.0018, 3e-4, (math.nan, math.nan), "N m s/rad")) == "0.0018 N m s/rad, no interval"
    assert str(Quantity(0.0018, 3e-4, (0.0012, math.nan), "N m s/rad")) == "0.0018 ± 0.0003 N m s/rad"


@given(NUMBERS, st.floats(1e-12, 1e12))
def test_text_is_within_an_error_of_the_number(value, error):
    shown, shown_error = str(Quantity(value, error)).split(" ± ")
    assert abs(float(shown) - value) <= max(0.51 * error, 1e-4 * abs(value))
    assert float(shown_error) == pytest.approx(error, rel=0.26)


def test_a_change_is_a_factor_of_the_nominal():
    assert Quantity(2.6, 0.1, nominal=2.0).factor == pytest.approx(1.3)
    assert math.isnan(Quantity(2.6, 0.1).factor) and math.isnan(Quantity(2.6, 0.1, nominal=0.0).factor)


@given(
    NUMBERS,
    NUMBERS | st.just(math.nan),
    st.none() | st.tuples(NUMBERS | st.just(math.nan), NUMBERS),
    st.none() | st.sampled_from(["", "rad"]),
    st.none() | NUMBERS,
)
def test_a_file_keeps_a_quantity_and_leaves_out_what_there_is_not(value, error, interval, unit, nominal):
    quantity = Quantity(value, error, interval, unit, nominal)
    entry = json.loads(json.dumps(to_jsonable(quantity.to_dict())))
    assert list(entry) == [name for name, content in vars(quantity).items() if content is not None]
    again = Quantity.read(entry | {"profile": [1.0]})
    # NaN is not equal to itself
    assert repr(again) == repr(quantity)


def test_a_table_leaves_out_columns_without_a_number():
    numbers = {"a": Quantity(1.0, math.nan, unit="rad"), "b": Quantity(2.0, 0.1, unit="s")}
    table = number_table("Numbers", {path: number.to_dict() for path, number in numbers.items()})
    assert table.columns == ["path", "value", "standard error", "unit"]
    assert table.rows == [["a", 1.0, None, "rad"], ["b", 2.0, 0.1, "s"]]
    full = number_table("Numbers", {"a": Quantity(1.0, 0.1, (0.8, 1.2), "rad", 0.9).to_dict()})
    assert full.columns == ["path", "value", "standard error", "95 % from", "to", "unit", "nominal"]
    assert full.rows == [["a", 1.0, 0.1, 0.8, 1.2, "rad", 0.9]]


def test_an_interval_without_an_end_has_the_value_there():
    assert Quantity(1.0, 0.1, (0.8, math.nan)).ends() == [0.8, 1.0] and Quantity(1.0, 0.1).ends() == []
    entries = {"a": {"value": 1.0, "standard_error": None, "interval": [None, 2.0]}}
    assert read_quantities(entries)["a"].ends() == [1.0, 2.0] and not read_quantities(entries)["a"].is_finite


def test_entries_are_made_and_read_in_one_place():
    places = set()
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            keys = [key.value for key in node.keys if isinstance(key, ast.Constant)] if isinstance(node, ast.Dict) else []
            makes = "standard_error" in keys and {"value", "interval", "unit"} & {*keys}
            names = []
            if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
                names = [node.slice]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get":
                names = node.args[:1]
            reads = any(isinstance(name, ast.Constant) and name.value in ("standard_error", "interval") for name in names)
            if makes or reads:
                places.add(file.relative_to(PACKAGE).as_posix())
    # `value` of a power law is the name of a metric
    assert places == {"gains/accuracy_laws.py"}
