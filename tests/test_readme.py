"""The README's Python examples run as they stand, shortened."""

import re
from pathlib import Path

import pytest

from sb3_cgp import CGP

README = (Path(__file__).parent.parent / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
# Past the warm-up of 500 random steps that the short examples have
LONGEST = 510


def test_there_are_examples():
    assert len(EXAMPLES) >= 4


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_readme_example_runs(example, monkeypatch, tmp_path):
    learn = CGP.learn
    monkeypatch.setattr(CGP, "learn", lambda self, steps, **kwargs: learn(self, min(steps, LONGEST), **kwargs))
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 2)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {"__name__": "__main__"})
