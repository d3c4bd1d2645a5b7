"""Sweeps whose files and options set a hyperparameter more than once: which one counts, and what is warned of."""

import pytest

from benchmark.sweeps.experiments import load_sweep


def test_later_settings_go_before_earlier_ones(tmp_path, sweep_of):
    sweep_of(hyperparams={"gamma": 0.9, "batch_size": 7}, axes={"batch_size": {"values": [8, 16]}})
    sweep = load_sweep(str(tmp_path / "mine.yml"), {"hyperparams": {"gamma": 0.5, "tau": 0.1}, "seeds": 1}, ["TD3"])
    assert [(run.hyperparams["gamma"], run.hyperparams["tau"], run.hyperparams["batch_size"]) for run in sweep.runs()] == [
        (0.5, 0.1, 8),
        (0.5, 0.1, 16),
    ]
    assert sweep.runs()[0].key == "TD3,batch_size=8,Pendulum-v1,seed=0"


@pytest.mark.parametrize(("options", "found"), [({}, [64, 8, 16]), ({"hyperparams": {"batch_size": 4}}, [4, 4, 4])])
def test_a_method_of_the_file_goes_before_what_the_file_has_for_all(tmp_path, sweep_of, options, found):
    sizes = {"big": {"batch_size": 64}, "small": {"batch_size": 8}, "usual": {}}
    methods = {name: {"algo": "td3", "hyperparams": size} for name, size in sizes.items()}
    sweep_of(hyperparams={"batch_size": 16, "learning_starts": 7}, methods=methods, seeds=1)
    runs = load_sweep(str(tmp_path / "mine.yml"), options).runs()
    assert [run.hyperparams["batch_size"] for run in runs] == found
    assert {run.hyperparams["learning_starts"] for run in runs} == {7}


@pytest.mark.parametrize(
    ("changes", "copies"),
    [
        ({"axes": {"batch": {"values": [8, 64], "sets": {"batch_size": 32}}}}, "TD3,batch=8 and TD3,batch=64"),
        (
            {"axes": {"a": {"values": [8, 16], "sets": {"batch_size": "$value"}}, "batch_size": {"values": [32]}}},
            "CGP-Online,a=8,batch_size=32 and CGP-Online,a=16,batch_size=32",
        ),
        (
            {
                "methods": {name: {"algo": "td3", "hyperparams": {"policy_kwargs": name}} for name in ("one", "other")},
                "axes": {"width": {"values": [4], "sets": {"policy_kwargs": "dict(net_arch=[$value])"}}},
            },
            "one,width=4 and other,width=4",
        ),
        ({"axes": {"gamma": {"values": [0.5, 0.9], "sets_for": {"TD3": {}}}}}, "TD3,gamma=0.5 and TD3,gamma=0.9"),
        ({"axes": {"gamma": {"values": [0.5, 0.9]}}}, None),
    ],
)
def test_configurations_that_are_the_same_are_named(sweep_of, capsys, changes, copies):
    sweep_of(**changes)
    told = capsys.readouterr().err
    assert f"mine.yml: {copies} have the same hyperparameters" in told if copies else told == ""


@pytest.mark.parametrize(
    ("axis", "is_replaced"),
    [
        ({"values": [0.5, 0.9]}, True),
        ({"values": [0.5], "sets": {"gamma": "$value"}}, True),
        ({"values": {"low": {"gamma": 0.5}, "high": {"gamma": 0.9}}}, True),
        ({"values": {"low": {"gamma": 0.5}, "none": {}}}, False),
        ({"values": [0.5], "sets_for": {"TD3": {}}}, False),
    ],
)
@pytest.mark.parametrize("by_file", [False, True])
def test_a_hyperparameter_that_axes_replace_in_every_run_is_named(tmp_path, sweep_of, capsys, axis, is_replaced, by_file):
    sweep_of(axes={"gamma": axis}, hyperparams={"gamma": 0.7} if by_file else None)
    capsys.readouterr()
    sweep = load_sweep(str(tmp_path / "mine.yml"), {"hyperparams": {"tau": 0.1} | ({} if by_file else {"gamma": 0.7})})
    warned = capsys.readouterr().err
    assert ("gamma has no effect, as the axis 'gamma' sets it in every run" in warned) is is_replaced
    assert ("gamma" in sweep.changes[0]) is (not by_file and not is_replaced)
    assert "tau" in sweep.changes[0]
