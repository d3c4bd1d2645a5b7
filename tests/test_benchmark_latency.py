"""``python -m benchmark.latency``: single actions, which agree. Times themselves are not tested."""

import numpy as np
from measuring_commands import run_command

from benchmark.speed import latencies
from sb3_cgp import CGP


def test_latency_is_of_single_actions_that_agree(tmp_path):
    record = run_command("latency", tmp_path, "--env", "Pendulum-v1", "--rounds", "3", "--actions", "2", "--device", "cpu")
    assert list(record["ways"]) == ["`predict`", "`load_weights`", "onnxruntime"]
    for figures in record["ways"].values():
        assert len(figures["seconds"]["all"]) == 3
        assert min(figures["seconds"]["all"]) > 0.0
    assert record["ways"]["`predict`"]["ratio_to_predict"] == 1.0
    text = (tmp_path / "latency.md").read_text()
    assert "medians of 3\nrounds of 2 actions each" in text
    model = CGP("MlpPolicy", "Pendulum-v1", buffer_size=1, seed=1)
    observation = np.array([0.6, -0.8, 3.0], np.float32)
    actions = [act(observation) for act in latencies.ways_to_act(model, tmp_path / "export", threads=1).values()]
    assert [action.shape for action in actions] == [(1,)] * 3
    assert np.allclose(actions, actions[0], atol=1e-4)
