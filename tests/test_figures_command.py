"""``python -m benchmark.figures``: which studies it takes, mistakes, and the commands that it prints."""

import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from finished_studies import BASELINES, GRID, runs, score, write_study

from benchmark import sweep
from benchmark.common.measuring import measuring_parser
from benchmark.figures import main
from benchmark.reporting import figures as command
from benchmark.reporting.figures import figures

ROOT = Path(__file__).parents[1]


@pytest.fixture
def folder(drawn_studies: Path) -> Path:
    return drawn_studies


def test_mistakes_are_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="is no folder; to take a study of that name from a storage"):
        main(["e33", "--folder", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"is no folder of a study: study.json is missing"):
        main([str(tmp_path), "--folder", str(tmp_path)])
    with pytest.raises(SystemExit, match="have the same name: axis, axis"):
        main([str(folder / "axis"), str(folder / "axis"), "--folder", str(tmp_path)])
    with pytest.raises(SystemExit):
        main([str(folder / "axis"), "--repetitions", "0", "--folder", str(tmp_path)])
    assert "'0' is not an integer >= 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("study.json", "{}", r"study\.json lacks title, .*tasks, .*\. Move it away"),
        ("study.json", "[]", r"study\.json must hold a mapping in JSON, and holds \[\]"),
        ("study.json", '{"title":\n', r"study\.json, line 2, is no JSON: Expecting value\. Move it away"),
        ("study.json", "\udcff", r"study\.json is no text in UTF-8\. Move it away"),
        ("study.json", None, r"study\.json is missing; give the command of its sweep again"),
        ("runs.jsonl", '{"seed": 1}\n', r"runs\.jsonl, line 1, is no record of a run: experiment: .*Move it away"),
        ("../../runtime/runtime.json", "", r"runtime\.json, line 1, is no JSON: .*benchmark\.runtime"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_a_damaged_file_is_named_with_a_remedy(tmp_path: Path, file: str, content: str | None, message: str) -> None:
    results = tmp_path / "sweeps"
    make(tmp_path / "runtime")
    study = write_study(make(results / "e1"), runs(score, BASELINES[:1]))
    if content is None:
        (study / file).unlink()
    else:
        (study / file).write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(SystemExit, match=f"^Error: .*{message}"):
        main(["--folder", str(results), "--repetitions", "20"])


@pytest.mark.usefixtures("undrawn")
def test_all_studies_of_a_folder(folder: Path, tmp_path: Path) -> None:
    for study in ("axis", "axes"):
        shutil.copytree(folder / study, tmp_path / study)
    options = ["--folder", str(tmp_path), "--repetitions", "20"]
    main(options)
    page = (tmp_path / "results.md").read_text()
    assert "## Pendulum-v1: The study axis, " in page
    assert "## Pendulum-v1: The study axes, " in page
    # As the shell has them in the place of `*/` and `*`, the folder of the figures and the page among them
    folders = [f"{path}/" for path in sorted(tmp_path.iterdir()) if path.is_dir()]
    assert str(tmp_path / "figures/") in [path.rstrip("/") for path in folders]
    for named in (folders, [str(path) for path in sorted(tmp_path.iterdir())]):
        main([*named, *options])
        assert (tmp_path / "results.md").read_text() == page
    with pytest.raises(SystemExit, match="holds no study"):
        main(["--folder", str(tmp_path / "axis")])


def test_named_study_is_taken_from_its_storage(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def export_study(name: str, storage: str, results: Path) -> Path:
        assert storage == "sqlite:///studies.db"
        if name != "mine":
            raise KeyError(name)
        return write_study(results / name, runs(score, BASELINES, GRID[:2]))

    monkeypatch.setitem(sys.modules, "benchmark.sweeps.exports", SimpleNamespace(export_study=export_study))
    options = ["--storage", "sqlite:///studies.db", "--folder", str(tmp_path), "--repetitions", "20"]
    main(["mine", *options])
    assert "The study mine" in (tmp_path / "results.md").read_text()
    with pytest.raises(SystemExit, match=r"The storage sqlite:///studies\.db holds no sweep yours"):
        main(["yours", *options])
    monkeypatch.setattr(sys.modules["benchmark.sweeps.exports"], "export_study", lambda name, *_: {}[name])
    with pytest.raises(SystemExit, match=r"The storage postgresql://me:\*\*\*@host/x holds no sweep yours"):
        main(["yours", "--storage", "postgresql://me:secret@host/x", "--folder", str(tmp_path)])


@pytest.mark.parametrize("studies", [[], ["{folder}/figures", "{folder}/results.md"]])
def test_a_storage_without_a_study_is_refused(studies: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([*(each.format(folder=tmp_path) for each in studies), "--storage", "sqlite:///x.db", "--folder", str(tmp_path)])
    assert "argument --storage: name the studies to take from it" in capsys.readouterr().err


def test_a_storage_that_does_not_answer_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "notes.db").write_text("no database")
    with pytest.raises(SystemExit, match="Error: the storage does not answer: file is not a database"):
        main(["mine", "--storage", f"sqlite:///{tmp_path}/notes.db", "--folder", str(tmp_path / "results")])


def test_printed_sweep_commands_name_a_folder_that_is_not_the_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for out, option in (
        ("tracked/my sweeps", " --results 'tracked/my sweeps'`"),
        (command.FOLDER.as_posix(), "benchmark.sweep mine`"),
    ):
        study = write_study(make(tmp_path / out / "mine"), runs(score, BASELINES[:1]))
        text = figures([study], tmp_path / out, 20).read_text()
        (line,) = [line for line in text.splitlines() if line.startswith("The runs: ")]
        assert option in line
        assert ("--results" in line) == ("--results" in option)


@pytest.mark.skipif(shutil.which("git") is None or not (ROOT / ".git").exists(), reason="needs a clone")
def test_the_results_of_a_user_are_not_tracked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [sweep.parse(["e3"]).results, command.FOLDER, measuring_parser("runtime", "", "", "").parse_args([]).folder]
    assert folders == [Path("results/sweeps"), Path("results/sweeps"), Path("results/runtime")]
    for folder in folders:
        assert subprocess.run(["git", "check-ignore", "-q", f"{folder}/results.md"], cwd=ROOT, check=False).returncode == 0
    tracked = "benchmark/results/sweeps/results.md"
    assert subprocess.run(["git", "check-ignore", "-q", tracked], cwd=ROOT, check=False).returncode == 1


def make(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def test_default_folder_is_left_out_of_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    line = command.command_line([command.FOLDER / "e3"], tmp_path / command.FOLDER, command.REPETITIONS)
    assert line == "python -m benchmark.figures results/sweeps/e3"
