"""The examples of the documentation's page on populations."""

import re
from pathlib import Path

import pytest

from sb3_cgp import CGP

PAGE = (Path(__file__).parent.parent / "docs" / "population.md").read_text()


@pytest.mark.parametrize("example", re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL), ids=range(3))
def test_the_pages_examples_run(example, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    exec(compile(example, "population.md", "exec"), names)
    if "evaluation" in names:
        assert names["evaluation"].mean_rewards.shape == (1, 3)
        assert CGP.load("agent_2").gamma == 0.95
