"""Objects of a user's modules: imported, or refused in one line."""

import pytest

from quadjax.core.errors import InputError
from quadjax.core.imports import load_object

REFUSED = {
    "math": r"reward\.terms is 'math', allowed: \"module:name\"",
    "../math:pi": "allowed",
    "no_such_module_here:x": "module no_such_module_here cannot be imported",
    "math:no_such_name": "has no 'no_such_name'",
    "leaves:x": r"cannot be imported \(SystemExit: 3\)",
    "broken_module:x": r"cannot be imported \(ZeroDivisionError: division by zero\)",
}


def test_an_object_of_a_module_next_to_the_config(tmp_path, monkeypatch):
    (tmp_path / "my_terms.py").write_text("class Terms:\n    weight = 3\n")
    (tmp_path / "broken_module.py").write_text("1 / 0\n")
    (tmp_path / "leaves.py").write_text("import sys\n\nsys.exit(3)\n")
    monkeypatch.chdir(tmp_path)
    assert load_object("my_terms:Terms.weight", "reward.terms") == 3
    for path, message in REFUSED.items():
        with pytest.raises(InputError, match=message) as caught:
            load_object(path, "reward.terms")
        assert "\n" not in str(caught.value)
