"""Installs in fresh virtual environments: regular and editable ones with rl_zoo3, whose scripts run there from another folder,
and plain ones without any extra.

The fresh environments use the packages of the one that runs the tests, so that nothing is downloaded, but not its start-up
files: those take effect only where they are installed. A plain environment has links to the packages that the wheel requires,
and to no other.
"""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# In one process, as its tests share environments that take long to set up
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]

ROOT = Path(__file__).parents[1]
SOURCES = ["sb3_cgp", "hyperparams", "_build_backend.py", "_sb3_cgp_zoo.py", "setup.cfg", "setup.py", "pyproject.toml"]
DOCUMENTS = [
    "MANIFEST.in",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "Makefile",
    "constraints.txt",
]
QUICK = ["learning_starts:100", "batch_size:8", "cem_samples:8", "buffer_size:1000"]
RUN = ["--algo", "cgp", "--env", "Pendulum-v1", "-f", "logs"]


@dataclass
class Environment:
    """A virtual environment, and a folder elsewhere to run things in."""

    folder: Path

    def path(self, name: str) -> Path:
        """One of sysconfig's paths, as "purelib" and "scripts"."""
        # Python 3.10 has no scheme for virtual environments, nor does it need one.
        scheme = "venv" if "venv" in sysconfig.get_scheme_names() else sysconfig.get_default_scheme()
        prefix = str(self.folder / "venv")
        return Path(sysconfig.get_path(name, scheme, {"base": prefix, "platbase": prefix}))

    def run(self, *arguments: str) -> str:
        """Run this environment's Python; its output, errors included."""
        python = self.path("scripts") / "python"
        variables = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "", "PYTHONPATH": ""}
        command, streams = [str(python), *arguments], {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        done = subprocess.run(command, cwd=self.folder / "elsewhere", env=variables, text=True, check=False, **streams)
        assert done.returncode == 0, f"{arguments}\n{done.stdout}"
        return done.stdout

    def pip(self, *arguments: str) -> str:
        return self.run("-m", "pip", *arguments)

    def files(self) -> set[str]:
        """Everything in site-packages."""
        site_packages = self.path("purelib")
        return {path.relative_to(site_packages).as_posix() for path in site_packages.rglob("*")} - {"__pycache__"}


def empty_environment(folder: Path) -> Environment:
    (folder / "elsewhere").mkdir(parents=True)
    venv.create(folder / "venv", symlinks=os.name != "nt")
    return Environment(folder)


def new_environment(folder: Path) -> Environment:
    environment = empty_environment(folder)
    # A path entry only: unlike in a site-packages folder of its own, .pth files in there are not processed.
    (environment.path("purelib") / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment


def requirements(names: list[str]) -> set[str]:
    """The distributions that requirements need, those of requirements included, without pip's extras."""
    found: set[str] = set()
    waiting = [(Requirement(name), "") for name in names]
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (requirement.marker is None or requirement.marker.evaluate({"extra": extra})) and name not in found:
            found.add(name)
            assert not requirement.extras, "the wanted extras of a requirement would be left out"
            waiting += [(Requirement(text), "") for text in importlib.metadata.requires(name) or []]
    return found


def link(environment: Environment, distribution: str) -> None:
    """Put links to a distribution's files into an environment, but for scripts and start-up files."""
    borrowed = Path(sysconfig.get_path("purelib"))
    tops = {file.parts[0] for file in importlib.metadata.files(distribution) if file.parts[0] not in ("..", "__pycache__")}
    for top in tops:
        target = environment.path("purelib") / top
        if not top.endswith(".pth") and (borrowed / top).exists() and not target.exists():
            target.symlink_to(borrowed / top)


@pytest.fixture(scope="module")
def plain(wheel, tmp_path_factory) -> Environment:
    """An environment in which the wheel is installed without extras, with what it requires and nothing else."""
    environment = empty_environment(tmp_path_factory.mktemp("plain"))
    (metadata,) = importlib.metadata.distributions(path=[str(wheel)])
    for name in requirements(metadata.requires):
        link(environment, name)
    # The wheel's files, as the environment has no pip
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(environment.path("purelib"))
    return environment


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of the source tree, as building leaves files behind."""
    folder = tmp_path_factory.mktemp("source")
    for name in SOURCES + DOCUMENTS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).is_file():
            shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)]
    # Builds an sdist, and the wheel from the sdist: what is missing there is missing here.
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module", params=["regular", "editable"])
def installed(request, source, wheel, tmp_path_factory) -> Environment:
    environment = new_environment(tmp_path_factory.mktemp(request.param))
    what = ["-e", str(source)] if request.param == "editable" else [str(wheel)]
    environment.pip("install", "--no-deps", "--no-build-isolation", *what)
    return environment


def test_the_wheel_holds_all_of_the_package_and_nothing_else(wheel, source):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = {path.relative_to(source).as_posix() for path in (source / "sb3_cgp").rglob("*") if path.is_file()}
    hyperparams = {f"sb3_cgp/{path.relative_to(source).as_posix()}" for path in (source / "hyperparams").rglob("*.yml")}
    assert "sb3_cgp/hyperparams/cgp.yml" in hyperparams
    assert {"sb3_cgp/py.typed", "sb3_cgp/version.txt"} <= package
    assert names == package | hyperparams | {"_sb3_cgp_zoo.py", "sb3_cgp.pth", "sb3_cgp.start"}


def test_a_wheel_from_the_source_tree_is_the_same(wheel, source, tmp_path):
    build = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(tmp_path), str(source)]
    subprocess.run(build, check=True, capture_output=True)
    (direct,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(direct) as other:
        assert {name: one.read(name) for name in one.namelist()} == {name: other.read(name) for name in other.namelist()}


def test_train_and_enjoy(installed):
    output = installed.run("-m", "rl_zoo3.train", *RUN, "-n", "300", "--eval-freq", "150", "-params", *QUICK)
    config = Path(re.search(r"Loading hyperparameters from: (.*)", output)[1])
    assert config.parts[-2:] == ("hyperparams", "cgp.yml")
    # Logged by the evaluation at step 300, before that step's update
    assert int(re.findall(r"n_updates\s*\|\s*(\d+)", output)[-1]) == 199
    assert "Warning" not in output
    assert "Mean reward" in installed.run("-m", "rl_zoo3.enjoy", *RUN, "--no-render", "-n", "200")


@pytest.mark.parametrize("script", ["push_to_hub", "load_from_hub"])
def test_hub_scripts_know_cgp(installed, script):
    assert "cgp" in installed.run("-m", f"rl_zoo3.{script}", "--help")


def test_hook_adds_under_a_millisecond_to_the_start(installed):
    outputs = [installed.run("-X", "importtime", "-c", "pass") for _ in range(10)]
    microseconds = [int(re.search(r"(\d+) \|\s*_sb3_cgp_zoo\n", output)[1]) for output in outputs]
    assert min(microseconds) < 1000
    loaded = installed.run("-c", "import sys; print(*sys.modules)").split()
    assert "_sb3_cgp_zoo" in loaded
    assert not {"sb3_cgp", "importlib.util", "warnings", "typing", "torch", "rl_zoo3"} & set(loaded)


@pytest.mark.parametrize("installed", ["regular"], indirect=True)
def test_other_algorithms_train_as_ever(installed):
    options = ["--algo", "td3", "--env", "Pendulum-v1", "-f", "logs", "-n", "110", "--eval-freq", "-1", "-params", QUICK[0]]
    assert os.path.join("rl_zoo3", "hyperparams", "td3.yml") in installed.run("-m", "rl_zoo3.train", *options)


@pytest.mark.parametrize("installed", ["regular"], indirect=True)
def test_plots_and_videos(installed):
    for seed in ("1", "2"):
        train = ["-m", "rl_zoo3.train", *RUN, "-f", "runs", "--seed", seed, "-n", "120"]
        installed.run(*train, "--eval-freq", "60", "--eval-episodes", "2", "-params", *QUICK)
    runs = ["-e", "Pendulum-v1", "-f", "runs"]
    table = installed.run("-m", "rl_zoo3.plots.all_plots", "-a", "cgp", *runs, "--no-display", "-o", "results")
    assert re.search(r"Pendulum-v1 *\|-\d+", table)
    installed.run("-m", "rl_zoo3.plots.plot_train", "-a", "cgp", *runs)
    plot = ["-i", "results.pkl", "-r", "-iqm", "-b", "-o", "curves", "--format", "png"]
    installed.run("-m", "rl_zoo3.plots.plot_from_file", *plot)
    installed.run("-m", "rl_zoo3.record_video", *RUN, "-f", "runs", "-n", "20", "--no-render")
    elsewhere = installed.folder / "elsewhere"
    assert list(elsewhere.glob("runs/cgp/Pendulum-v1_2/videos/*.mp4"))
    assert list(elsewhere.glob("curves*"))


@pytest.mark.parametrize("installed", ["regular"], indirect=True)
def test_optimize_and_train_a_trial(installed):
    study = ["--storage", "study.log", "--study-name", "cgp"]
    # A seed whose first two samples are cheap ones: few and small batches, online
    options = ["-optimize", "--sampler", "random", "--seed", "61", "--n-trials", "2", "--n-evaluations", "1"]
    train = ["-m", "rl_zoo3.train", *RUN, *study]
    assert "Number of finished trials:  2" in installed.run(*train, *options, "-n", "150", "-params", *QUICK)
    # rl_zoo3 ignores trial 0.
    output = installed.run(*train, "--trial-id", "1", "-n", "110", "--eval-freq", "-1", "-params", QUICK[0])
    assert "Loading from Optuna study" in output
    assert "cem_elites" in output


def test_uninstall_leaves_nothing(source, wheel, tmp_path):
    environment = new_environment(tmp_path)
    before = environment.files()
    for what in (["-e", str(source)], [str(wheel)]):
        environment.pip("install", "--no-deps", "--no-build-isolation", *what)
        assert environment.files() >= before | {"sb3_cgp.pth", "sb3_cgp.start", "_sb3_cgp_zoo.py"}
        environment.pip("uninstall", "--yes", "sb3-cgp")
        assert environment.files() == before


def test_rl_zoo3_survives_a_half_deleted_sb3_cgp(source, tmp_path):
    checkout = shutil.copytree(source, tmp_path / "checkout")
    environment = new_environment(tmp_path)
    environment.pip("install", "--no-deps", "--no-build-isolation", "-e", str(checkout))
    shutil.rmtree(checkout)
    assert environment.run("-c", "import torch") == ""
    output = environment.run("-c", "import rl_zoo3; print(*rl_zoo3.ALGOS)")
    assert output.count("RuntimeWarning: sb3_cgp is installed but could not register itself") == 1
    assert "td3" in output


def test_a_plain_install_trains_and_has_nothing_of_an_extra(plain):
    installed = {path.name.lower() for path in plain.path("purelib").iterdir()}
    assert {"sb3_cgp", "stable_baselines3", "gymnasium", "torch", "numpy", "filelock"} <= installed
    extras = {"rl_zoo3", "optuna", "tensorboard", "matplotlib", "pandas", "scipy", "mujoco", "pygame", "safetensors", "yaml"}
    assert not installed & extras
    train = "CGP('MlpPolicy', 'Pendulum-v1', learning_starts=20, batch_size=8).learn(60, log_interval=1).save('model')"
    assert plain.run("-c", f"from sb3_cgp import CGP; {train}") == ""
    assert plain.run("-c", "from sb3_cgp import CGP; print(CGP.load('model').num_timesteps)") == "60\n"


def test_the_hook_of_a_plain_install_is_silent(plain):
    # Python prints the errors of .pth files
    assert plain.run("-c", "import sys; print('_sb3_cgp_zoo' in sys.modules, 'sb3_cgp' in sys.modules)") == "True False\n"
    missing = "try:\n import rl_zoo3.utils\nexcept ModuleNotFoundError as error:\n print(error)"
    assert plain.run("-c", missing) == "No module named 'rl_zoo3'\n"


@pytest.mark.parametrize(
    ("code", "extra", "missing"),
    [
        ("import sb3_cgp.zoo; sb3_cgp.zoo.register()", "zoo", "rl_zoo3"),
        ("from sb3_cgp.zoo.resume import main; main(['logs/cgp/Pendulum-v1_1'])", "zoo", "rl_zoo3"),
        (f"import sys; sys.path.append({str(ROOT)!r}); import benchmark.report", "zoo", "rl_zoo3"),
        ("from sb3_cgp import CGP; CGP.load_weights('export')", "export", "safetensors"),
        ("from sb3_cgp import CGP; CGP('MlpPolicy', 'Pendulum-v1', buffer_size=10).export('export')", "export", "safetensors"),
    ],
)
def test_what_a_plain_install_lacks_is_named_with_the_extra(code, extra, missing, plain):
    catching = f"try:\n {code}\nexcept (ImportError, SystemExit) as error:\n print(error)"
    remedy = f'It is in the extra `{extra}`: in a clone, pip install -c constraints.txt -e ".[{extra}]"; with the wheel'
    assert f"needs {missing}, which is not installed. {remedy}" in plain.run("-c", catching)
