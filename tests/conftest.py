"""What tests share: one thread; the CPU, so that the same is tested with and without a GPU; fixtures of several modules."""

import errno
import os
import shutil
import signal
from pathlib import Path

import gymnasium as gym
import pytest
import torch as th
import yaml

from sb3_cgp.resumption.signals import StopSignals

HAS_GPU = th.cuda.is_available()


@pytest.fixture(scope="session", autouse=True)
def _cpu():
    """Hide the GPU: what computes on "auto" is compared with the CPU's results, often to the bit."""
    with pytest.MonkeyPatch.context() as patch:
        if HAS_GPU:
            # PyTorch counts GPUs once, then or never
            th.cuda.init()
            assert th.cuda.device_count() > 0
        patch.setattr(th.cuda, "is_available", lambda: False)
        # For the processes that tests start
        patch.setenv("CUDA_VISIBLE_DEVICES", "")
        yield


@pytest.fixture(autouse=True)
def _one_thread():
    # The networks of the tests are too small to gain from more, and test processes run side by side
    th.set_num_threads(1)


@pytest.fixture(autouse=True)
def _signal_handlers():
    """Restore the handlers that a command sets for as long as its process lives."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def handler():
    """SIGTERM's handler, which every training must leave as it was, and no training that is asked to end."""
    handler = signal.getsignal(signal.SIGTERM)
    yield handler
    assert not StopSignals.is_asked()
    left, _ = signal.getsignal(signal.SIGTERM), signal.signal(signal.SIGTERM, handler)
    assert left is handler


@pytest.fixture
def gpu(monkeypatch):
    """Show the GPU to a test; without one, skip it."""
    if not HAS_GPU:
        pytest.skip("needs a GPU")
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)


@pytest.fixture
def heeds_interruptions():
    """Have a test and the processes that it starts heed Ctrl-C: what a shell has put into the background ignores it."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def in_tmp_path(monkeypatch, tmp_path):
    """Work in the test's own folder, where default and relative paths then lie."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def short_policy_training(monkeypatch):
    """Rounds of 10 steps, so that offline training takes a moment."""
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)


@pytest.fixture
def short_episodes(monkeypatch):
    """End Pendulum-v1's episodes after 25 steps rather than 200: evaluations are most of a tiny training's time otherwise."""
    monkeypatch.setattr(gym.spec("Pendulum-v1"), "max_episode_steps", 25)


@pytest.fixture
def fail_to_lock(monkeypatch):
    """Let each lock of a file fail by an error; by default that of a file system without locks."""

    def fail(number=errno.ENOSYS):
        def flock(*_):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr("fcntl.flock", flock)

    return fail


@pytest.fixture
def no_onnx(monkeypatch):
    """ONNX takes a second to make: leave it out where it is not at issue."""
    monkeypatch.setattr("sb3_cgp.export.write._checked_onnx", lambda *args: b"another")


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """Two different exports, and their models; not to be written to."""
    # Here, as ONNX takes a second to import
    from exports import make_model

    folders, models = [], []
    for seed in (0, 1):
        folders.append(tmp_path_factory.mktemp("export"))
        models.append(make_model(seed=seed, normalize=dict() if seed == 0 else None))
        models[-1].export(folders[-1])
    return folders, models


@pytest.fixture(scope="module")
def dict_export(tmp_path_factory):
    """An export of goals and images, of which the goals are normalised, and its model; not to be written to."""
    from exports import make_goal_model

    folder = tmp_path_factory.mktemp("dict_export")
    model = make_goal_model()
    model.export(folder)
    return folder, model


@pytest.fixture
def folder(exports, tmp_path):
    """A copy of an export, to be spoilt."""
    return Path(shutil.copytree(exports[0][0], tmp_path / "export"))


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test moves, and stand-ins for what takes time in a sweep."""
    # Here, as Optuna takes a second to import
    from studies import Clock, pretend

    clock = Clock()
    pretend(monkeypatch, clock)
    return clock


@pytest.fixture
def float64(monkeypatch):
    """Networks in double precision, so that rounding does not decide between two samples of CEM."""
    monkeypatch.setattr("stable_baselines3.common.policies.preprocess_obs", lambda obs, *args, **kwargs: obs.double())
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


@pytest.fixture
def stand_in(monkeypatch):
    """Capture on the CPU, by the stand-in."""
    from graph_models import StandIn

    from sb3_cgp.fast import cuda_graph_algorithm, cuda_graphs

    monkeypatch.setattr(cuda_graph_algorithm, "has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    monkeypatch.setattr(StandIn, "made", 0)


@pytest.fixture
def work(tmp_path, monkeypatch):
    """Tune in this process, which stands for one that its parent has started."""
    # Here, as Optuna takes a second to import
    from optuna.storages import InMemoryStorage
    from tunings import arguments, tuner_of

    from benchmark import tune
    from benchmark.sweeps import tune_execution

    monkeypatch.setattr("benchmark.sweeps.run.FINAL_EPISODES", 1)

    def act(*argv, storage=None, grace=60.0, **options):
        storage = storage or InMemoryStorage()
        args = tune.parse(arguments(*argv, "--logs", str(tmp_path), "--parent", str(os.getppid()), **options))
        own = tuner_of(args, storage, grace)
        tune_execution.execute_trials(own, args)
        return own.trials()

    return act


@pytest.fixture
def pretend(monkeypatch):
    """Let runs give what a function of the run says, and note them."""
    runs = []

    def act(score):
        def train(run, folder, report, watch, device):
            runs.append((run.method, run.seed))
            return score(run)

        monkeypatch.setattr("benchmark.sweeps.tuner.train", train)
        return runs

    return act


@pytest.fixture
def short_final_evaluation(monkeypatch):
    """Evaluate a finished run in two episodes: this is most of a tiny run's time otherwise."""
    for module in ("run", "population_run"):
        monkeypatch.setattr(f"benchmark.sweeps.{module}.FINAL_EPISODES", 2)


@pytest.fixture
def sweep_of(tmp_path):
    """Write a sweep's file, mine.yml, and read it."""
    # Here, as pydantic takes a moment to import
    from benchmark.sweeps.experiments import load_sweep

    content = dict(title="A sweep", methods=["TD3", "CGP-Online"], tasks=["Pendulum-v1"], steps=100, seeds=2)
    content["evaluation_interval"] = 10

    def write_and_load(**changes):
        path = tmp_path / "mine.yml"
        path.write_text(yaml.safe_dump({key: value for key, value in (content | changes).items() if value is not None}))
        return load_sweep(str(path))

    return write_and_load


@pytest.fixture
def ledger():
    """A ledger of three runs: seeds 0 to 2."""
    # Here, as Optuna takes a second to import
    from ledgers import open_ledger
    from optuna.storages import InMemoryStorage
    from studies import Clock

    return open_ledger(InMemoryStorage(), Clock())


@pytest.fixture(scope="session")
def drawn_studies(tmp_path_factory):
    """Studies: of tasks, of an axis, of two axes, and of other methods than the rest; not to be written to."""
    # Here, as Matplotlib takes a second to import
    from finished_studies import BASELINES, GRID, runs, score, write_study

    from benchmark.reporting.figures import figures, study_folders

    folder = tmp_path_factory.mktemp("sweeps")
    write_study(folder / "tasks", runs(score, [*BASELINES, "My-PPO"], tasks=("Pendulum-v1", "ALE/Pong-v5")))
    write_study(folder / "axis", runs(score, BASELINES, [{"learning_rate": 0.01}, {"learning_rate": 0.001}]), planned=30)
    write_study(folder / "axes", runs(score, BASELINES, GRID))
    write_study(folder / "variants", runs(score, ["CGP-Online", "CGP-Offline"], GRID[:2]))
    figures(study_folders(folder), folder, repetitions=100)
    return folder


@pytest.fixture
def undrawn(monkeypatch):
    """Write empty files in place of pictures, for tests of what the page says."""
    for name in ("curves_by_steps", "curves_by_minutes", "final_rewards", "stability", "sensitivity", "values"):
        monkeypatch.setattr(f"benchmark.reporting.figures.{name}", lambda *args: b"")


@pytest.fixture
def drawn(monkeypatch):
    """Keep the figures of learning curves in place of their pictures."""
    kept = []
    monkeypatch.setattr("benchmark.reporting.learning_curves.png", lambda figure: kept.append(figure) or b"")
    return kept
