"""Arguments of the measuring commands."""

import pytest
from measuring_commands import COMMANDS, CPU

from benchmark import precision, selector
from benchmark.common import arguments


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("runtime", "--episodes 0", "argument --episodes: '0' is not an integer >= 1"),
        ("runtime", "--episode-steps 1.5", "argument --episode-steps: '1.5' is not an integer >= 1"),
        ("runtime", "--methods PPO", "argument --methods: invalid choice: 'PPO'"),
        ("runtime", "--env Nowhere-v0", "argument --env: 'Nowhere-v0' cannot be made"),
        ("runtime", "--env CartPole-v1", "argument --env: 'CartPole-v1' has no continuous actions"),
        ("selector", "--dtypes int8", "argument --dtypes: invalid choice: 'int8'"),
        ("selector", "--threads -1", "argument --threads: '-1' is not an integer >= 1"),
        ("selector", "--device abacus", "argument --device: 'abacus' is not available"),
        ("selector", "--seed -1", "argument --seed: '-1' is not an integer within [0, 2**32)"),
        ("selector", "--seed 4294967296", "argument --seed: '4294967296' is not an integer within [0, 2**32)"),
        ("precision", "--seeds 0 -1", "argument --seeds: '-1' is not an integer within [0, 2**32)"),
        ("latency", "--env CartPole-v1", "argument --env: 'CartPole-v1' has no continuous actions"),
        ("latency", "--actions 0", "argument --actions: '0' is not an integer >= 1"),
        ("scaling", "--axes seed", "argument --axes: invalid choice: 'seed'"),
        ("scaling", "--rounds many", "argument --rounds: 'many' is not an integer >= 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, capsys, name, options, message):
    with pytest.raises(SystemExit):
        (COMMANDS | {"precision": precision})[name].parse([*options.split(), "--folder", str(tmp_path)])
    assert message in capsys.readouterr().err


def test_missing_gpu_is_not_replaced_quietly(capsys):
    with pytest.raises(SystemExit):
        selector.parse(["--device", "cuda"])
    assert "argument --device: 'cuda' is not available" in capsys.readouterr().err
    assert arguments.device("auto") == CPU


def test_folder_that_cannot_be_made_is_named_before_anything_is_measured(tmp_path, capsys):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit):
        selector.parse(["--folder", str(tmp_path / "file" / "folder")])
    assert "argument --folder: " in capsys.readouterr().err
