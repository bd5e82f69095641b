"""First models of files as drives, robots and scopes write them."""

from collections import Counter

import pytest
from vendor_layouts import APART, LAYOUTS, judge


@pytest.mark.parametrize("layouts", [LAYOUTS, APART])
def test_eight_of_ten_files_need_no_hand(layouts, tmp_path):
    judged = [judge(write, 5, tmp_path) for write in layouts]
    assert Counter(outcome for outcome, _ in judged)["right"] >= 8, judged
    assert not any("WHOLE RATIO" in text or outcome == "traceback" for outcome, text in judged)
