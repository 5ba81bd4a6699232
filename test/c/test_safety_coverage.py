"""Of the files on which the heater's safety rests every line and branch is reached by the tests written for them."""

from __future__ import annotations

from safety_coverage import uncovered


def test_the_safety_files_have_no_line_and_no_branch_without_a_test() -> None:
    found = uncovered()
    assert not found, "\n" + "\n".join(found)
