"""Goldens: every kind of change in results is reported, and by how much; what is the same, or reworded, is no move."""

import json

import numpy as np
import pandas as pd
import pytest
from golden.comparison import compare_folders
from goldens import report

SUMMARY = {"verdict": "explained", "unit": "N m s/rad", "remark": "nothing but noise is left", "numbers": [1.0, 2.0, None]}


@pytest.fixture
def compare(tmp_path):
    """Differences of two contents of one file."""

    def differences(name, base, tree, tolerance=0.0):
        for side, content in (("base", base), ("tree", tree)):
            path = tmp_path / side / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, pd.DataFrame):
                content.to_parquet(path)
            else:
                path.write_text(content if isinstance(content, str) else json.dumps(content))
        return compare_folders(tmp_path / "base", tmp_path / "tree", tolerance)

    return differences


def test_equal_results_do_not_differ(compare):
    table = pd.DataFrame({"metric": [1.0, np.nan], "kind": ["a", "b"]})
    assert compare("part.parquet", table, table) == []
    assert compare("summary.json", SUMMARY, dict(reversed(SUMMARY.items()))) == []


@pytest.mark.parametrize(
    ("change", "place", "difference_text"),
    [
        ({"findings": []}, "findings", "key is new ([])"),
        ({"verdict": "unknown_effect"}, "verdict", "'explained' -> 'unknown_effect'"),
        ({"unit": "N m"}, "unit", "'N m s/rad' -> 'N m'"),
        ({"numbers": [1.0, 2.0]}, "numbers", "3 elements -> 2"),
        ({"numbers": [1.0, 2.0, 3.0]}, "numbers[]", "None -> 3.0"),
        ({"numbers": [1.0, 2.0 + 2e-6, None]}, "numbers[]", "2.0 -> 2.000002 (by 1.0e-06 of it)"),
    ],
)
def test_a_changed_key_name_or_number_is_reported(compare, change, place, difference_text):
    (difference,) = compare("summary.json", SUMMARY, SUMMARY | change, 1e-9)
    assert (difference.place, difference.text, difference.is_sentence) == (place, difference_text, False)


def test_a_key_that_is_gone_is_reported_once_for_all_elements_of_a_list(compare):
    base = {"findings": [{"effect": "motor.cogging", "z": 3.0}, {"effect": "load.gravity", "z": 4.0}]}
    tree = {"findings": [{"effect": "motor.cogging"}, {"effect": "load.gravity"}]}
    (difference,) = compare("diagnosis.json", base, tree)
    assert (difference.place, difference.text) == ("findings[].z", "key is gone, and 1 more")


def test_numbers_within_the_tolerance_are_the_same(compare):
    close_summary = SUMMARY | {"numbers": [1.0, 2.0 + 1e-6, None]}
    assert compare("summary.json", SUMMARY, close_summary, 1e-6) == []
    (difference,) = compare("summary.json", SUMMARY, close_summary)
    assert difference.relative == pytest.approx(5e-7)


def test_a_sentence_in_other_words_is_told_from_a_move(compare):
    (difference,) = compare("summary.json", SUMMARY, SUMMARY | {"remark": "only noise is left"})
    assert difference.is_sentence


def test_one_bit_of_a_table_is_reported(compare):
    table = pd.DataFrame({"metric": [1.0, 2.0, np.nan]})
    changed_table = pd.DataFrame({"metric": [1.0, np.nextafter(2.0, 3.0), np.nan]})
    (difference,) = compare("part.parquet", table, changed_table)
    assert difference.place == "metric" and difference.text.startswith("1 of 3 numbers")
    assert difference.relative == pytest.approx(2.2e-16, rel=0.02)
    assert compare("part.parquet", table, changed_table, 1e-9) == []
    (difference,) = compare("part.parquet", table, table.rename(columns={"metric": "rmse"}).assign(metric=table["metric"]))
    assert (difference.place, difference.text) == ("rmse", "column is new")
    (difference,) = compare("part.parquet", table, table.fillna(0.0), 1e-9)
    assert difference.relative == np.inf


def test_code_moves_with_its_first_line_and_comments_are_told_apart(compare):
    code = "/* gain */\nx = 1.5;\ny = 2.0;\n"
    (difference,) = compare("drive.c", code, code.replace("2.0", "2.00"))
    assert (difference.place, difference.text) == ("", "line 3: 'y = 2.0;' -> 'y = 2.00;'")
    (difference,) = compare("drive.c", code, code.replace("gain", "the gain"))
    assert difference.address == "drive.c: comments"


def test_files_that_come_and_go_are_reported(tmp_path):
    for side, name in (("base", "gains.toml"), ("tree", "tuning.toml")):
        (tmp_path / side).mkdir()
        (tmp_path / side / name).write_text("")
    differences = compare_folders(tmp_path / "base", tmp_path / "tree", 0.0)
    assert [str(difference) for difference in differences] == ["gains.toml: is gone", "tuning.toml: is new"]


def test_a_move_that_is_listed_is_expected(compare, capsys):
    differences = compare("drive.c", "x = 1;\n", "x = 2;\n")
    assert report("export_code", differences, {}, 9)
    assert "export_code: MOVED" in capsys.readouterr().out
    assert not report("export_code", differences, {"export_code/*.c": "a reason"}, 9)
    assert "export_code: same (1 expected differences)" in capsys.readouterr().out
