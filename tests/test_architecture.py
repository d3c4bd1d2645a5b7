"""The examples of the architecture's page run as they stand."""

import re
from pathlib import Path

import pytest

from sb3_cgp import CGP
from sb3_cgp.core.losses import POLICY_LOSSES

PAGE = (Path(__file__).parent.parent / "docs" / "architecture.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_example_runs(example, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    # Fewer steps than the page has, past the warm-up
    exec(compile(example.replace(".learn(1_000)", ".learn(510)"), "architecture.md", "exec"), {"__name__": "__main__"})


def test_every_file_that_the_page_names_exists():
    package = Path(__file__).parent.parent / "sb3_cgp"
    named = set(re.findall(r"`((?:core|selectors|fast|guards|resumption|export|zoo|common)/\w+\.py)`", PAGE))
    assert len(named) > 8
    assert [name for name in sorted(named) if not (package / name).is_file()] == []


@pytest.mark.parametrize("policy_training", ["online", "offline"])
def test_a_policy_loss_takes_one_entry(policy_training, monkeypatch, tmp_path):
    (example,) = (each for each in EXAMPLES if "def advantage_loss" in each)
    names = {}
    exec(example, names)
    monkeypatch.setitem(POLICY_LOSSES, "advantage", names["advantage_loss"])
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 5)
    arguments = dict(learning_starts=20, batch_size=8, policy_kwargs=dict(net_arch=[8]), seed=0)
    model = CGP("MlpPolicy", "Pendulum-v1", policy_loss="advantage", policy_training=policy_training, **arguments)
    before = next(model.actor.parameters()).clone()
    model.learn(60).save(tmp_path / "model")
    assert not before.equal(next(model.actor.parameters()))
    assert CGP.load(tmp_path / "model").policy_loss == "advantage"
    with pytest.raises(ValueError, match="must be one of 'cgp', 'qgp', 'advantage', None"):
        CGP("MlpPolicy", "Pendulum-v1", policy_loss="hubert")
