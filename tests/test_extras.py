"""The extras: what a plain install imports, what works in it, and errors that name the extra."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmark.sweeps.storages import open_storage
from sb3_cgp import __version__
from sb3_cgp.common.extras import how_to_install, import_from_extra, require_from_extra
from sb3_cgp.zoo import register
from sb3_cgp.zoo.resume import main

ROOT = Path(__file__).parents[1]
EXTRAS = ("huggingface_sb3", "matplotlib", "onnx", "onnxruntime", "onnxscript", "optuna", "pandas", "pydantic", "rl_zoo3")
EXTRAS += ("safetensors", "sb3_contrib", "scipy", "tensorboard", "tqdm", "yaml")


def python(code: str) -> str:
    """Run code in another process; return its output."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_package_imports_nothing_that_sb3_does_not_but_filelock():
    # SB3 itself imports TensorBoard, Matplotlib and pandas where they are installed
    loaded = python(
        "import sys, stable_baselines3; before = set(sys.modules)\n"
        "import sb3_cgp; names = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "print(*sorted(names - sys.stdlib_module_names))"
    ).split()
    assert "sb3_cgp" in loaded
    assert set(loaded) <= {"sb3_cgp", "filelock"}


def test_without_the_extras_a_model_is_trained_saved_and_resumed(tmp_path):
    code = f"""
import sys
for name in {EXTRAS}:
    sys.modules[name] = None
from sb3_cgp import CGP, TrainingCheckpointCallback
arguments = dict(learning_starts=5, batch_size=4, buffer_size=100, cem_samples=8, cem_elites=2)
checkpoint = TrainingCheckpointCallback(save_freq=20, path={str(tmp_path / "states")!r})
model = CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[4]), **arguments).learn(30, callback=checkpoint)
model.save({str(tmp_path / "model")!r})
assert CGP.load({str(tmp_path / "model")!r}).num_timesteps == 30
resumed = CGP.resume({str(tmp_path / "states")!r}, "Pendulum-v1")
print("resumed at", resumed.num_timesteps)
"""
    assert "resumed at 30" in python(code)


@pytest.mark.parametrize("missing", ["rl_zoo3", "rl_zoo3.utils"])
def test_registration_and_resumption_without_rl_zoo3_name_the_extra(missing, monkeypatch, tmp_path):
    for name in [name for name in sys.modules if name.partition(".")[0] == "rl_zoo3"]:
        # A second import of this one would replace Gymnasium's TimeLimit by another class for all later tests
        if name != "rl_zoo3.gym_patches":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    remedy = rf"needs {missing}, which is not installed. It is in the extra `zoo`: {re.escape(how_to_install('zoo'))}"
    with pytest.raises(ImportError, match=f"Registering CGP in rl_zoo3 {remedy}"):
        register()
    with pytest.raises(SystemExit, match=f"Error: Resuming a run of rl_zoo3 {remedy}"):
        main([str(tmp_path)])


def test_a_module_that_fails_otherwise_fails_as_ever(monkeypatch, tmp_path):
    (tmp_path / "broken_module.py").write_text("raise ImportError('another reason')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"^another reason$"):
        import_from_extra("broken_module", "zoo", "A test")


def test_a_package_that_is_required_is_not_imported(monkeypatch, tmp_path):
    (tmp_path / "package_of_an_extra.py").write_text("raise AssertionError('it was imported')")
    monkeypatch.syspath_prepend(tmp_path)
    require_from_extra("package_of_an_extra", "zoo", "A test")
    with pytest.raises(ImportError, match=r'A test needs missing_package, .* -e "\.\[zoo\]"'):
        require_from_extra("missing_package", "zoo", "A test")


def test_the_advice_on_extras_needs_no_package_index_that_has_sb3_cgp():
    """Each command names a path, of a clone or of a wheel, with the extra behind it."""
    advice = how_to_install("export")
    targets = re.findall(r'pip install [^;"]*"([^"]*)"', advice)
    assert targets == [".[export]", f"sb3_cgp-{__version__}-py3-none-any.whl[export]"]
    assert "-c constraints.txt" in advice


def test_the_page_on_troubles_gives_the_same_advice_and_is_linked():
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    for command in re.findall(r"pip install [^;]*", how_to_install("export")):
        assert command in page
    assert "(docs/troubleshooting.md)" in (ROOT / "README.md").read_text()


COMMANDS = sorted(path.stem for path in (ROOT / "benchmark").glob("*.py") if path.stem != "__init__")
SWEEPS, EXPORT = ("sweep", "tune", "worker"), ("latency",)


@pytest.mark.parametrize(
    ("missing", "extra", "refused"),
    [
        ("rl_zoo3", "zoo", COMMANDS),
        ("rliable", "zoo", COMMANDS),
        ("pydantic", "sweeps", SWEEPS),
        ("onnxscript", "export", EXPORT),
    ],
)
def test_every_command_of_benchmark_names_the_extra_that_it_lacks(missing, extra, refused):
    """No other command needs the extra."""
    found = python(f"""
import importlib, sys
sys.modules[{missing!r}] = None
for command in {COMMANDS}:
    try:
        importlib.import_module(f"benchmark.{{command}}")
    except ImportError as error:
        print(command, error, sep="|")
""").splitlines()
    messages = dict(line.split("|") for line in found)
    assert sorted(messages) == sorted(refused)
    expected = f"needs {missing}, which is not installed. It is in the extra `{extra}`: {how_to_install(extra)}"
    assert all(message.endswith(expected) for message in messages.values())


def test_every_command_of_benchmark_helps_with_an_example_its_duration_and_the_place_of_its_results():
    helps = python(f"""
import contextlib, importlib, io, sys
for command in {COMMANDS}:
    module = importlib.import_module(f"benchmark.{{command}}")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        module.main(["--help"])
    print(printed.getvalue(), end="----")
""").split("----")
    for command, text in zip(COMMANDS, helps[:-1], strict=True):
        epilog = text[re.search(r"^examples?[:,]", text, re.MULTILINE).start() :]
        assert f"  python -m benchmark.{command}" in epilog
        assert re.search(r"[Ii]t takes|takes ten minutes|ends when no run is left|writes nothing", epilog), command
        assert re.search(r"written to|--logs|writes nothing", epilog), command
        assert max(map(len, epilog.splitlines())) <= 132
    sweep = helps[COMMANDS.index("sweep")]
    names = [line.split()[0] for line in sweep.partition("sweeps:\n")[2].splitlines()[:9]]
    assert names == [f"e{number}" for number in (*range(1, 9), 10)]


def test_a_database_whose_driver_is_missing_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg2", None)
    with pytest.raises(
        ValueError,
        match=re.escape(f"driver psycopg2 is not installed. It is in the extra `sweeps`: {how_to_install('sweeps')}"),
    ):
        open_storage("postgresql://user@host/sweeps")
