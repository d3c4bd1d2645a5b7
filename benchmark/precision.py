"""
What bfloat16 costs: how many of CEM's elites differ from float32's on a trained critic, and which rewards training ends at.

``python -m benchmark.precision`` trains with both data types and writes a record per run, then ``precision.md``. Runs that
have their record are not repeated, so that it can be interrupted, and run in several processes with different seeds.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from scipy import stats
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim

from benchmark.common.arguments import continuous_environment, count, measuring_parser
from benchmark.common.files import markdown_table, write_json
from benchmark.common.provenance import conditions
from benchmark.report import EVALUATION_SEED
from benchmark.speed.training import train_by_zoo
from sb3_cgp import CEM, CGP
from sb3_cgp.common.files import write_atomically
from sb3_cgp.core.cem import Score
from sb3_cgp.fast.scoring import q_score

DTYPES = ("float32", "bfloat16")
EPISODES = 20
# Replayed states whose elites are compared
STATES = 2_000
NOTES = """\
Return: mean and standard deviation over the seeds of each run's mean over {episodes} episodes of its final model. Difference:
bfloat16 less float32, with Welch's 95 % confidence interval; p is Welch's t-test's and the exact Mann-Whitney test's. Elites:
the share of float32's elites that are bfloat16's, too, in CEM's first and second iteration, by the critic and by the target
critic that float32's runs ended with, on {states:,} replayed states each; both choose among the same samples. Shown are
the mean over the seeds and the lowest seed's."""


def elite_overlaps(cem: CEM, exact: Score, rounded: Score, n_states: int, action_dim: int) -> list[float]:
    """
    Compare the elites of two scoring functions along CEM's search by the first.

    :param cem: the search
    :param exact: scores (B, N, A) -> (B, N), and is followed
    :param rounded: scores in the same way, and is only compared
    :param n_states: number of states, B
    :param action_dim: action dimensions, A
    :return: for each iteration, the share of the first's elites that are the second's, too
    """
    overlaps = []

    def score(actions: th.Tensor) -> th.Tensor:
        values = exact(actions)
        elites, others = (scores.topk(cem.elites, dim=1).indices for scores in (values, rounded(actions)))
        shared = (elites.unsqueeze(2) == others.unsqueeze(1)).any(dim=2)
        overlaps.append(shared.float().mean().item())
        return values

    cem.select(score, n_states, action_dim)
    return overlaps


@th.no_grad()
def critic_overlaps(model: CGP, critic: ContinuousCritic) -> list[float]:
    """
    Compare the elites of bfloat16 with float32's on a model's replayed states.

    :param model: the model, trained
    :param critic: its critic or its target critic
    :return: the overlap in each iteration
    """
    model.policy.set_training_mode(False)
    assert model.replay_buffer is not None
    observations = model.replay_buffer.sample(STATES, env=model.get_vec_normalize_env()).observations
    features = critic.extract_features(observations, critic.features_extractor)
    network = critic.q_networks[0]
    exact, rounded = (q_score(network, features, dtype) for dtype in (th.float32, th.bfloat16))
    cem = model.policy.selector
    assert isinstance(cem, CEM)
    return elite_overlaps(cem, exact, rounded, len(features), get_action_dim(model.action_space))


def run(env_id: str, dtype: str, seed: int, args: argparse.Namespace, argv: Sequence[str]) -> dict[str, Any]:
    """
    Train and evaluate once.

    :param env_id: the environment
    :param dtype: ``cem_dtype``
    :param seed: the seed
    :param args: the command line
    :param argv: its arguments, for the record
    :return: the record
    """
    hyperparams = {"cem_dtype": dtype} | ({} if args.steps is None else {"n_timesteps": args.steps})
    model = train_by_zoo(env_id, hyperparams, seed, args.device)
    env = make_vec_env(env_id, seed=EVALUATION_SEED)
    returns, _ = evaluate_policy(model, env, EPISODES, return_episode_rewards=True)
    record = {
        **conditions("benchmark.precision", argv, model.device),
        "env": env_id,
        "dtype": dtype,
        "seed": seed,
        "steps": model.num_timesteps,
        "returns": returns,
    }
    if dtype == "float32":
        networks = {"critic": model.critic, "target critic": model.critic_target}
        record["overlaps"] = {name: critic_overlaps(model, network) for name, network in networks.items()}
    return record


def compare(float32: Sequence[float], bfloat16: Sequence[float]) -> dict[str, Any]:
    """
    Compare final rewards.

    :param float32: each seed's mean return with float32
    :param bfloat16: each seed's mean return with bfloat16
    :return: the difference of the means, its 95 % confidence interval, and the p-values of two tests
    """
    welch = stats.ttest_ind(bfloat16, float32, equal_var=False)
    interval = welch.confidence_interval(0.95)
    return {
        "difference": float(np.mean(bfloat16) - np.mean(float32)),
        "interval": (float(interval.low), float(interval.high)),
        "welch_p": float(welch.pvalue),
        "mann_whitney_p": float(stats.mannwhitneyu(bfloat16, float32, method="exact").pvalue),
    }


def read_records(folder: Path) -> list[dict[str, Any]]:
    """
    Read the runs that are done.

    :param folder: where their records lie
    :return: the records, by task, data type and seed
    """
    records = [json.loads(path.read_text()) for path in folder.glob("*_seed*.json")]
    return sorted(records, key=lambda record: (record["env"], record["dtype"], record["seed"]))


def reward_row(runs: list[dict[str, Any]]) -> list[str]:
    """
    Write a line of the table of rewards.

    :param runs: a task's records
    :return: the cells
    """
    means = {dtype: [float(np.mean(run["returns"])) for run in runs if run["dtype"] == dtype] for dtype in DTYPES}
    seeds = (", ".join(str(run["seed"]) for run in runs if run["dtype"] == dtype) for dtype in DTYPES)
    row = [runs[0]["env"], " / ".join(dict.fromkeys(filter(None, seeds))), f"{runs[0]['steps']:,}"]
    if any(len(values) < 2 for values in means.values()):
        return [*row, "-", "-", "-", "-"]
    row += [f"{np.mean(values):.1f} ± {np.std(values, ddof=1):.1f}" for values in means.values()]
    found = compare(means["float32"], means["bfloat16"])
    low, high = found["interval"]
    return [
        *row,
        f"{found['difference']:.1f} ({low:.1f} to {high:.1f})",
        f"{found['welch_p']:.2f}, {found['mann_whitney_p']:.2f}",
    ]


def elite_rows(runs: list[dict[str, Any]]) -> list[list[str]]:
    """
    Write the lines of the table of elites.

    :param runs: a task's records
    :return: the cells of a line for each network
    """
    compared = [run["overlaps"] for run in runs if "overlaps" in run]
    rows = []
    for network in compared[0] if compared else []:
        shares = np.array([overlaps[network] for overlaps in compared])
        rows.append([runs[0]["env"], network, *(f"{np.mean(column):.1%} ({np.min(column):.1%})" for column in shares.T)])
    return rows


def markdown(records: list[dict[str, Any]]) -> str:
    """
    Write the tables of rewards and of elites.

    :param records: the runs
    :return: both, in Markdown
    """
    tasks = [[record for record in records if record["env"] == env_id] for env_id in sorted({r["env"] for r in records})]
    return "\n\n".join(
        [
            "# What bfloat16 costs",
            markdown_table(["task", "seeds", "steps", *DTYPES, "difference", "p"], [reward_row(runs) for runs in tasks]),
            markdown_table(
                ["task", "network", "first iteration", "second iteration"], [row for runs in tasks for row in elite_rows(runs)]
            ),
            NOTES.format(episodes=EPISODES, states=STATES),
            "The records beside this page hold each run's command, versions and hardware.\n",
        ]
    )


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    parser = measuring_parser("precision", "Compare training with CEM in bfloat16 and in float32.", with_seed=False)
    parser.add_argument(
        "--envs", nargs="*", type=continuous_environment, default=["Pendulum-v1"], help="environments (default: Pendulum-v1)"
    )
    parser.add_argument(
        "--steps", type=count, help="environment steps (default: what the YAML file says, 1e6 for the paper's tasks)"
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4], help="seeds of the training (default: 0 to 4)"
    )
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Train what has no record yet, and write the tables of all that has.

    :param argv: the command line; None for the process's own
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    for env_id in args.envs:
        for seed in args.seeds:
            for dtype in DTYPES:
                path = args.folder / f"{env_id}_{dtype}_seed{seed}.json"
                if not path.exists():
                    write_json(path, run(env_id, dtype, seed, args, argv))
    text = markdown(read_records(args.folder))
    write_atomically(args.folder / "precision.md", text.encode())
    print(text)


if __name__ == "__main__":
    main()
