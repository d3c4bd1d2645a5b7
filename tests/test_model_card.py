"""The model cards that ``rl_zoo3.push_to_hub`` writes, without a network: what it would upload is looked at."""

import re
import runpy
import sys

import gymnasium as gym
import pytest
import yaml
from gymnasium.envs.registration import EnvSpec
from huggingface_hub import HfApi, repocard
from rl_zoo3.train import train

from sb3_cgp import CGP
from sb3_cgp.zoo import register
from sb3_cgp.zoo.model_card import _registering_import


@pytest.fixture
def push(monkeypatch, tmp_path):
    """Train an algorithm as rl_zoo3 does, push it, and return the card's metadata, the card and the folder."""
    register()
    uploaded = []
    monkeypatch.setattr(HfApi, "create_repo", lambda self, **kwargs: f"https://huggingface.co/{kwargs['repo_id']}")
    monkeypatch.setattr(HfApi, "snapshot_download", lambda self, repo_id, local_dir: local_dir.mkdir(parents=True))
    monkeypatch.setattr(HfApi, "upload_folder", lambda self, **kwargs: uploaded.append(kwargs))
    monkeypatch.chdir(tmp_path)

    def push_algorithm(algo, *options, **parameters):
        small = dict(learning_starts=20, buffer_size=100, batch_size=8, policy_kwargs="dict(net_arch=[4])") | parameters
        arguments = f"--algo {algo} --env Pendulum-v1 -f logs"
        params = [f"{name}:{value}" for name, value in small.items()]
        options_of_train = "--eval-freq -1 --n-timesteps 40 --device cpu --num-threads 1 --verbose 0 -params"
        monkeypatch.setattr(sys, "argv", ["train.py", *arguments.split(), *options_of_train.split(), *params])
        train()
        monkeypatch.setattr(sys, "argv", ["push_to_hub.py", *arguments.split(), "-orga", "someone", "--no-render", *options])
        monkeypatch.delitem(sys.modules, "rl_zoo3.push_to_hub", raising=False)
        runpy.run_module("rl_zoo3.push_to_hub", run_name="__main__")
        (upload,) = uploaded
        text = (upload["folder_path"] / "README.md").read_text(encoding="utf-8")
        _, metadata, card = text.split("---\n", 2)
        return yaml.safe_load(metadata), card, upload["folder_path"]

    return push_algorithm


def test_the_card_of_cgp(push):
    metadata, card, _ = push("cgp")
    assert metadata["library_name"] == "stable-baselines3"
    assert {"Pendulum-v1", "reinforcement-learning", "cgp", "sb3-cgp"} <= set(metadata["tags"])
    assert len(metadata["tags"]) == len(set(metadata["tags"]))
    (model,) = metadata["model-index"]
    result = model["results"][0]["metrics"][0]["value"]
    assert (model["name"], model["results"][0]["dataset"]["name"]) == ("CGP", "Pendulum-v1")
    assert card.count("# **CGP** Agent playing **Pendulum-v1**") == 1
    assert "arxiv.org/abs/1903.10605" in card
    assert f"# it was {result}" in card
    # Nobody is told that the RL Zoo alone has the algorithm
    assert "pip install rl_zoo3" not in card
    assert '".[zoo]"' in card
    download = "python -m rl_zoo3.load_from_hub --algo cgp --env Pendulum-v1 -orga someone -f logs/"
    assert f"TRUST_REMOTE_CODE=True {download}" in card
    assert "VecNormalize" not in card
    assert "wrapped" not in card
    # rl_zoo3's own list of hyperparameters
    assert card.count("## Hyperparameters") == 1
    assert "('learning_starts', 20)" in card


@pytest.mark.parametrize("normalize", [False, True], ids=["plain", "normalised"])
def test_the_cards_example_runs_on_what_is_uploaded(normalize, push, monkeypatch, capsys):
    _, card, folder = push("cgp", "-name", "my-pendulum", normalize=normalize)
    assert "-orga someone -name my-pendulum -f logs/" in card
    asked = []

    def download(repo_id, filename):
        asked.append((repo_id, filename))
        return str(folder / filename)

    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    (example,) = (each for each in re.findall(r"```python\n(.*?)```", card, flags=re.DOTALL) if "import" in each)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    assert isinstance(names["model"], CGP)
    files = ["cgp-Pendulum-v1.zip", *["vec_normalize.pkl"] * normalize]
    assert asked == [("someone/my-pendulum", file) for file in files]
    assert re.search(r"^-\d+\.\d\d \+/- \d+\.\d\d$", capsys.readouterr().out, flags=re.MULTILINE)


def test_wrappers_are_mentioned(push):
    _, card, _ = push("cgp", env_wrapper="'gymnasium.wrappers.FlattenObservation'")
    assert "wrapped as `env_wrapper` below says" in card


def test_cards_of_other_algorithms_are_rl_zoo3s(push):
    metadata, card, _ = push("td3")
    assert "sb3-cgp" not in metadata["tags"]
    assert "pip install rl_zoo3" in card
    assert "sb3_cgp" not in card


def test_other_files_of_a_model_called_cgp_are_left_alone(tmp_path):
    register()
    path = tmp_path / "README.md"
    for text in (None, "# A card of somebody's own\n"):
        if text is not None:
            path.write_text(text)
        repocard.metadata_save(path, {"model-index": [{"name": "CGP", "results": []}]})
        assert path.read_text().endswith(f"---\n{text or ''}")
    repocard.metadata_save(path, {"license": "mit"})
    assert repocard.metadata_load(path) == {"license": "mit"}


def test_registering_twice_completes_once():
    register()
    save = repocard.metadata_save
    register()
    assert repocard.metadata_save is save


@pytest.mark.parametrize(
    ("entry_point", "line"),
    [
        ("panda_gym.envs:PandaReachEnv", "import panda_gym  # registers Mine-v0\n"),
        ("mine:Env", "import mine  # registers Mine-v0\n"),
        ("gymnasium.envs.classic_control.pendulum:PendulumEnv", ""),
        (lambda: None, ""),
    ],
)
def test_the_package_that_registers_the_environment_is_imported(entry_point, line, monkeypatch):
    monkeypatch.setitem(gym.registry, "Mine-v0", EnvSpec("Mine-v0", entry_point))
    assert _registering_import("Mine-v0") == line
    assert _registering_import("Unknown-v0") == ""
