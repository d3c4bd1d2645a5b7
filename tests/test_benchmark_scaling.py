"""``python -m benchmark.scaling``: what it varies and what it draws. Times themselves are not tested."""

import pytest
from gymnasium.utils.env_checker import check_env
from matplotlib.image import imread
from measuring_commands import CPU, run_command

from benchmark import scaling
from benchmark.speed import scaling_points
from benchmark.speed.boxes import BoxEnv


def test_scaling_draws_what_it_measures(tmp_path, monkeypatch):
    monkeypatch.setattr(scaling_points, "AXES", {"cem_samples": (8, 16), "observation_dim": (3, 5), "n_envs": (1, 2)})
    options = "--env Pendulum-v1 --rounds 2 --gradient-steps 2 --axes cem_samples observation_dim n_envs"
    record = run_command("scaling", tmp_path, *options.split())
    points = record["points"]
    assert [(point["axis"], point["value"], point["algorithm"]) for point in points] == [
        (axis, value, algorithm)
        for axis, values in scaling_points.AXES.items()
        for value in values
        for algorithm in ("CGP", "TD3")
    ]
    for point in points:
        assert len(point["gradient_step_seconds"]["all"]) == 2
        assert ("env_steps_per_second" in point) == (point["axis"] == "n_envs")
    # TD3 has no samples: one measurement serves all along the axis
    assert points[1]["gradient_step_seconds"] == points[3]["gradient_step_seconds"]
    picture = imread(tmp_path / "scaling.png", format="png")
    assert picture.shape[1] > picture.shape[0] > 300
    assert picture[..., :3].std() > 0.01, "the picture is blank"


def test_scaling_divides_by_the_steps_that_are_made(tmp_path, monkeypatch):
    def one_second_each(runs, rounds, **_):
        for run in runs.values():
            model = run.func.__self__
            updates, timesteps = model._n_updates, model.num_timesteps
            run()
            assert model._n_updates - updates == 4
            assert model.num_timesteps - timesteps in (0, 4 * model.n_envs)
        return {setting: [1.0] * rounds for setting in runs}

    monkeypatch.setattr(scaling_points, "interleaved", one_second_each)
    monkeypatch.setattr(scaling_points, "AXES", {"n_envs": (1, 3)})
    options = f"--env Pendulum-v1 --rounds 2 --gradient-steps 4 --axes n_envs --folder {tmp_path}"
    points = scaling_points.measure(scaling.parse(options.split()))["points"]
    assert {point["gradient_step_seconds"]["median"] for point in points} == {1 / 4}
    assert [point["env_steps_per_second"]["median"] for point in points] == [4.0, 4.0, 12.0, 12.0]


@pytest.mark.parametrize("algorithm", ["CGP", "TD3"])
def test_scaling_varies_the_model(algorithm):
    varied = {"cem_iterations": 3, "cem_samples": 9, "width": 8, "action_dim": 4, "observation_dim": 11, "n_envs": 2}
    for axis, value in varied.items():
        setting = scaling_points.setting_at(algorithm, axis, value)
        model = scaling_points.make_model(setting, scaling_points.make_env(setting, "Pendulum-v1", seed=0), seed=0, device=CPU)
        assert model._n_updates == 1
        inputs = 3 + 1 if axis == "n_envs" else 11 + 6 if axis == "observation_dim" else 17 + 4 if axis == "action_dim" else 23
        first = model.critic.q_networks[0][0]
        assert (first.in_features, first.out_features) == (inputs, 8 if axis == "width" else 256)
        assert model.n_envs == (2 if axis == "n_envs" else 1)
        if algorithm == "CGP":
            assert model.cem_iterations == (3 if axis == "cem_iterations" else 2)
            assert model.cem_samples == (9 if axis == "cem_samples" else 64)


@pytest.mark.filterwarnings("ignore:.*A Box observation space:UserWarning")
def test_box_env_keeps_to_its_spaces():
    check_env(BoxEnv(5, 3), skip_render_check=True)
