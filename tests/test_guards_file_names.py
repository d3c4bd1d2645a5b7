"""Files and folders of the same name: what was saved is found beside what was exported, or beside training states."""

from pathlib import Path

import numpy as np
import pytest
import torch as th
from guarded import SMALL, GuardedTD3, located

from sb3_cgp import CGP, TrainingCheckpointCallback

TINY = dict(learning_starts=5, batch_size=4, buffer_size=100, policy_kwargs=dict(net_arch=[4]), device="cpu")


def assert_same_parameters(model, other):
    for name, parameter in model.policy.state_dict().items():
        assert th.equal(parameter, other.policy.state_dict()[name]), name


@pytest.mark.parametrize(
    ("neighbour", "kind", "name"),
    [("export", str, "cgp_pendulum"), ("export", Path, "cgp_0.5"), ("states", str, "cgp_0.5"), ("states", Path, "cgp")],
)
def test_a_model_and_its_buffer_are_found_beside_a_folder_of_the_same_name(name, kind, neighbour, tmp_path):
    path = kind(tmp_path / name)
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    if neighbour == "export":
        model.learn(8).export(path)
    else:
        model.learn(8, callback=TrainingCheckpointCallback(save_freq=4, path=path))
    model.save(path)
    model.save_replay_buffer(path)
    loaded = CGP.load(path)
    assert_same_parameters(model, loaded)
    loaded.load_replay_buffer(path)
    np.testing.assert_array_equal(loaded.replay_buffer.rewards, model.replay_buffer.rewards)
    fresh = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    fresh.set_parameters(path)
    assert_same_parameters(model, fresh)
    if neighbour == "export":
        np.testing.assert_allclose(CGP.load_weights(path).predict(np.zeros(3, np.float32))[0], model.predict(np.zeros(3))[0])
    else:
        assert CGP.resume(path, "Pendulum-v1").num_timesteps == 8


def test_the_folder_may_come_after_the_files(tmp_path):
    """As in a script that saves a model, and exports it then."""
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    model.save(tmp_path / "cgp_pendulum")
    model.export(tmp_path / "cgp_pendulum")
    assert_same_parameters(CGP.load(tmp_path / "cgp_pendulum"), model)


def test_the_guard_serves_other_algorithms(tmp_path):
    model = GuardedTD3("MlpPolicy", located(), **SMALL)
    model.save(tmp_path / "td3")
    (tmp_path / "td3").mkdir()
    assert_same_parameters(GuardedTD3.load(tmp_path / "td3"), model)
    with pytest.raises(IsADirectoryError, match=r"Is a folder, and there is no file .*td3\.pkl: '.*td3'"):
        model.load_replay_buffer(tmp_path / "td3")


def test_a_folder_without_a_file_names_what_reads_folders(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    readers = "`load_weights` reads a folder of an exported policy; `resume` reads a folder of training states"
    for read in (CGP.load, model.set_parameters):
        with pytest.raises(IsADirectoryError, match=f"there is no file {tmp_path}.zip; {readers}"):
            read(tmp_path)


def test_a_file_in_the_place_of_a_folder_is_refused_by_name(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    path = tmp_path / "model"
    model.save(path)
    with pytest.raises(FileNotFoundError, match=f"no training state in {path}: `load` reads a model that `save` wrote"):
        CGP.resume(path, "Pendulum-v1")
    with pytest.raises(
        NotADirectoryError, match=r"Is a file, and no folder that `export` wrote; `load` reads a model: '.*zip'"
    ):
        CGP.load_weights(f"{path}.zip")
    with pytest.raises(FileNotFoundError, match=r"no exported policy; `load` reads the model .*model\.zip: '.*model'"):
        CGP.load_weights(path)
    before = Path(f"{path}.zip").read_bytes()
    with pytest.raises(FileExistsError, match=r"Is a file, and must be a folder or a new name: '.*zip'"):
        model.export(f"{path}.zip")
    assert Path(f"{path}.zip").read_bytes() == before
