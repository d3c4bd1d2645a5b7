"""
The model card that ``rl_zoo3.push_to_hub --algo cgp`` uploads.

rl_zoo3's own card says that the RL Zoo, SB3 and SB3-Contrib suffice to load the model, and nothing of sb3-cgp.
"""

import functools
import re
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_cgp import CGP, __version__
from sb3_cgp.common.extras import how_to_install
from sb3_cgp.zoo.folders import ALGO

TAGS = ("cgp", "sb3-cgp")
# rl_zoo3's card is kept from here on
KEPT = "## Hyperparameters"

CARD = """
# **CGP** Agent playing **{env_id}**

This is a trained model of a **CGP** agent (Cross-Entropy Guided Policies, [Simmons-Edler et al., 2019](https://arxiv.org/abs/1903.10605))
playing **{env_id}**, trained by sb3-cgp {version} with the
[stable-baselines3 library](https://github.com/DLR-RM/stable-baselines3) and the
[RL Zoo](https://github.com/DLR-RM/rl-baselines3-zoo).

None of these two, nor SB3-Contrib, contains CGP. Install sb3-cgp with its extra `zoo`, which makes `cgp` known to the RL Zoo:
{installation}.

A model is loaded by `pickle`, which can run any code: load those models only whose authors you trust.

## Usage (with the RL Zoo)

```bash
# Download the model into the folder logs
TRUST_REMOTE_CODE=True python -m rl_zoo3.load_from_hub --algo cgp --env {env_id} -orga {organization}{repo_option} -f logs/
python -m rl_zoo3.enjoy --algo cgp --env {env_id} -f logs/
```

## Usage (with Python)

```python
{registering_import}from huggingface_hub import hf_hub_download
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy{vec_normalize_import}

from sb3_cgp import CGP

model = CGP.load(hf_hub_download("{organization}/{repo}", "{file}"))
env = make_vec_env("{env_id}")
{vec_normalize}mean_reward, std_reward = evaluate_policy(model, env, n_eval_episodes=10)
print(f"{{mean_reward:.2f}} +/- {{std_reward:.2f}}")  # it was {result}
```
{wrappers}
## Training (with the RL Zoo)

```bash
python -m rl_zoo3.train --algo cgp --env {env_id} -f logs/
# Upload the model, and a video of it if that can be recorded
python -m rl_zoo3.push_to_hub --algo cgp --env {env_id} -f logs/ -orga {organization}{repo_option}
```

"""
VEC_NORMALIZE = """env = VecNormalize.load(hf_hub_download("{organization}/{repo}", "vec_normalize.pkl"), env)
env.training = env.norm_reward = False
"""
WRAPPERS = """
The environment was wrapped as `{}` below says, which the RL Zoo does by itself.
"""


def complete_model_cards() -> None:
    """
    Have the model cards of CGP completed when rl_zoo3 saves them. A repetition has no effect.

    ``rl_zoo3.push_to_hub`` runs as Python's main module, whose functions cannot be replaced before they run. It saves a card
    by a call of huggingface_hub's ``metadata_save``, which is replaced here.
    """
    from huggingface_hub import repocard

    save = repocard.metadata_save
    if hasattr(save, "completes_cards_of_cgp"):
        return

    @functools.wraps(save)
    def metadata_save(local_path: str | Path, data: dict[str, Any]) -> None:
        path = Path(local_path)
        if _is_of_cgp(path, data):
            path.write_text(_card(path, data), encoding="utf-8")
            data = data | {"tags": [*data.get("tags", []), *TAGS]}
        save(local_path, data)

    metadata_save.completes_cards_of_cgp = True  # type: ignore[attr-defined]
    repocard.metadata_save = metadata_save


def _registering_import(env_id: str) -> str:
    """Return the line that imports the package which registers an environment; an empty one for Gymnasium's own."""
    spec = gym.registry.get(env_id)
    entry_point = None if spec is None else spec.entry_point
    package = entry_point.split(".")[0].split(":")[0] if isinstance(entry_point, str) else "gymnasium"
    return "" if package == "gymnasium" else f"import {package}  # registers {env_id}\n"


def _is_of_cgp(path: Path, data: dict[str, Any]) -> bool:
    """
    Return whether a card is one of rl_zoo3's for CGP.

    :param path: the card's file
    :param data: the card's metadata
    """
    models = [each.get("name") for each in data.get("model-index", [])]
    return models == [CGP.__name__] and path.is_file() and f"rl_zoo3.enjoy --algo {ALGO} " in path.read_text(encoding="utf-8")


def _card(path: Path, data: dict[str, Any]) -> str:
    """
    Return the card for a model of CGP.

    :param path: the file of rl_zoo3's card, in the folder to upload, whose name is the repository's
    :param data: the card's metadata
    :return: the card, without metadata
    """
    from huggingface_sb3 import EnvironmentName, ModelName

    theirs = path.read_text(encoding="utf-8")
    (result,) = data["model-index"][0]["results"]
    model_name = ModelName(ALGO, EnvironmentName(result["dataset"]["name"]))
    organization = re.search(r"-orga (\S+)", theirs)
    assert organization is not None, "rl_zoo3's card names the organization"
    folder = path.resolve().parent
    values = {
        "env_id": result["dataset"]["name"],
        "version": __version__,
        "installation": how_to_install("zoo"),
        "organization": organization[1],
        "repo": folder.name,
        "repo_option": "" if folder.name == model_name else f" -name {folder.name}",
        "file": model_name.filename,
        "result": result["metrics"][0]["value"],
        "registering_import": _registering_import(result["dataset"]["name"]),
        "vec_normalize": "",
        "vec_normalize_import": "",
    }
    if (folder / "vec_normalize.pkl").is_file():
        values["vec_normalize"] = VEC_NORMALIZE.format(**values)
        values["vec_normalize_import"] = "\nfrom stable_baselines3.common.vec_env import VecNormalize"
    kept = theirs[theirs.find(KEPT) :] if KEPT in theirs else ""
    wrapping = [name for name in ("env_wrapper", "vec_env_wrapper", "frame_stack") if f"'{name}'" in kept]
    values["wrappers"] = WRAPPERS.format("`, `".join(wrapping)) if wrapping else ""
    return CARD.format(**values) + kept
