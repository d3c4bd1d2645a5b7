"""The start-up hook, in Python processes of its own, with stand-ins for rl_zoo3 and sb3_cgp that import nothing."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("_build_backend", ROOT / "_build_backend.py")
BACKEND = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(BACKEND)
PTH_LINE = BACKEND.STARTUP_LINES["sb3_cgp.pth"]

ZOO = """
import sys
def register_algorithm(): sys.modules["rl_zoo3.utils"].ALGOS["cgp"] = "CGP"
def register_search_space(): sys.modules["rl_zoo3.hyperparams_opt"].SAMPLER["cgp"] = "sampler"
def register_default_config(): sys.modules["rl_zoo3.exp_manager"].PATCHED = True
"""
IMPORT_ALL = "import rl_zoo3, rl_zoo3.exp_manager as e, rl_zoo3.hyperparams_opt as h, rl_zoo3.utils as u; "
SHOW_ALL = "print(rl_zoo3.ALGOS, h.SAMPLER, e.PATCHED)"


@pytest.fixture
def folder(tmp_path):
    """A folder for ``sys.path`` with the hook and the stand-ins."""
    files = {
        "_sb3_cgp_zoo.py": (ROOT / "_sb3_cgp_zoo.py").read_text(),
        "rl_zoo3/__init__.py": "from rl_zoo3.utils import ALGOS",
        "rl_zoo3/utils.py": "ALGOS = {'td3': 'TD3'}",
        "rl_zoo3/hyperparams_opt.py": "SAMPLER = {}",
        "rl_zoo3/exp_manager.py": "PATCHED = False",
        "sb3_cgp/__init__.py": "",
        "sb3_cgp/zoo/registration.py": ZOO,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def python(folder: Path, code: str) -> subprocess.CompletedProcess:
    """Run code in a Python that has processed our ``.pth`` line, as ``site`` does, and has no other packages."""
    started = f"import sys; sys.path.insert(0, {str(folder)!r}); exec({PTH_LINE!r}); {code}"
    return subprocess.run([sys.executable, "-I", "-S", "-c", started], capture_output=True, text=True, check=False)


def test_registers_when_rl_zoo3_is_imported(folder):
    done = python(folder, IMPORT_ALL + SHOW_ALL)
    assert (done.stdout, done.stderr) == ("{'td3': 'TD3', 'cgp': 'CGP'} {'cgp': 'sampler'} True\n", "")


def test_registers_again_when_rl_zoo3_is_reloaded(folder):
    done = python(folder, IMPORT_ALL + "import importlib; importlib.reload(u); print(u.ALGOS)")
    assert (done.stdout, done.stderr) == ("{'td3': 'TD3', 'cgp': 'CGP'}\n", "")


def test_leaves_the_modules_as_they_are(folder):
    done = python(folder, IMPORT_ALL + "import inspect; print(type(u.__loader__).__name__, inspect.getsource(u), end='')")
    assert (done.stdout, done.stderr) == ("SourceFileLoader ALGOS = {'td3': 'TD3'}\n", "")


def test_works_in_a_zip_archive_where_modules_share_a_loader(folder):
    archive = shutil.make_archive(str(folder.with_suffix(".packages")), "zip", folder)
    # Found and not yet executed: the execution of another module must not register it.
    find = "import importlib.util, rl_zoo3; importlib.util.find_spec('rl_zoo3.exp_manager'); import rl_zoo3.hyperparams_opt; "
    done = python(Path(archive), find + IMPORT_ALL + SHOW_ALL)
    assert (done.stdout, done.stderr) == ("{'td3': 'TD3', 'cgp': 'CGP'} {'cgp': 'sampler'} True\n", "")


def test_gets_on_with_another_finder_of_its_kind(folder):
    # Two finders that each ask all of sys.meta_path would call each other without end.
    (folder / "other.py").write_text(
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, *args):\n"
        "        specs = [finder.find_spec(*args) for finder in sys.meta_path if finder is not self]\n"
        "        return next((spec for spec in specs if spec), None)\n"
        "sys.meta_path.insert(0, Finder())\n"
    )
    done = python(folder, "import other; " + IMPORT_ALL + SHOW_ALL)
    assert (done.stdout, done.stderr) == ("{'td3': 'TD3', 'cgp': 'CGP'} {'cgp': 'sampler'} True\n", "")


def test_imports_nothing_at_start(folder):
    loaded = "print(sorted(sys.modules))"
    with_hook = python(folder, loaded)
    (folder / "_sb3_cgp_zoo.py").unlink()
    without_hook = python(folder, loaded)
    assert set(eval(with_hook.stdout)) - set(eval(without_hook.stdout)) == {"_sb3_cgp_zoo"}


def test_imports_sb3_cgp_only_once_rl_zoo3_is_imported(folder):
    done = python(folder, "print('sb3_cgp' in sys.modules); import rl_zoo3; print('sb3_cgp' in sys.modules)")
    assert (done.stdout, done.stderr) == ("False\nTrue\n", "")


@pytest.mark.parametrize(
    ("broken", "named"),
    [
        ({"sb3_cgp/zoo/registration.py": None, "sb3_cgp/__init__.py": None}, "ImportError"),
        ({"sb3_cgp/__init__.py": "raise RuntimeError('half installed')"}, "RuntimeError: half installed"),
        ({"sb3_cgp/zoo/registration.py": "def register_algorithm("}, "SyntaxError"),
        ({"sb3_cgp/zoo/registration.py": ""}, "AttributeError"),
        ({"sb3_cgp/zoo/registration.py": ZOO + "\ndel register_default_config"}, "AttributeError"),
    ],
)
def test_a_broken_sb3_cgp_costs_rl_zoo3_one_warning(folder, broken, named):
    for name, text in broken.items():
        (folder / name).unlink()
        if text is not None:
            (folder / name).write_text(text)
    done = python(folder, IMPORT_ALL + "print(rl_zoo3.ALGOS['td3'])")
    assert (done.returncode, done.stdout) == (0, "TD3\n")
    assert done.stderr.count("Warning") == 1
    assert "RuntimeWarning: sb3_cgp is installed but could not register itself in rl_zoo3" in done.stderr
    assert named in done.stderr


def test_without_rl_zoo3_its_import_fails_as_ever(folder):
    for file in (folder / "rl_zoo3").iterdir():
        file.unlink()
    (folder / "rl_zoo3").rmdir()
    done = python(folder, "import rl_zoo3.utils")
    assert done.stderr.splitlines()[-1] == "ModuleNotFoundError: No module named 'rl_zoo3'"


@pytest.mark.parametrize("text", [None, "raise RuntimeError", "def install(", "", "import nothing_of_that_name"])
def test_a_broken_hook_is_silent_at_start(folder, text):
    (folder / "_sb3_cgp_zoo.py").unlink()
    if text is not None:
        (folder / "_sb3_cgp_zoo.py").write_text(text)
    done = python(folder, "import rl_zoo3; print('started')")
    assert (done.stdout, done.stderr) == ("started\n", "")


def test_install_twice_is_install_once(folder):
    done = python(folder, "import _sb3_cgp_zoo; n = len(sys.meta_path); _sb3_cgp_zoo.install(); print(len(sys.meta_path) - n)")
    assert (done.stdout, done.stderr) == ("0\n", "")


def test_start_file_names_the_function_that_the_pth_line_calls():
    # Python 3.15's form (PEP 829); from that version on a .pth line beside it is not executed.
    assert BACKEND.STARTUP_LINES["sb3_cgp.start"] == "_sb3_cgp_zoo:install\n"
    assert "_sb3_cgp_zoo.install()" in PTH_LINE
    assert PTH_LINE.startswith("import ")
    assert PTH_LINE.index("\n") == len(PTH_LINE) - 1
