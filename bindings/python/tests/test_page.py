"""The programs of docs/python.md that need nothing else run, one behind the other, as they are printed."""

import re

from conftest import REPOSITORY


def test_the_programs_of_the_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs" / "python.md").read_text(), re.S)
    first = next(block for block in blocks if "alice" in block)
    products = next(block for block in blocks if "distance_field" in block)
    names: dict[str, object] = {}
    exec(first, names)  # noqa: S102
    names["version"] = 0
    exec(products, names)  # noqa: S102
    assert names["field"].distances().shape == (25, 40, 10)
    assert (tmp_path / "map.bt").is_file()
    assert capsys.readouterr().out.startswith("(")
