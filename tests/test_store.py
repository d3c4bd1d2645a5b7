"""Training states on the disk: what was saved comes back, or is refused by name, whatever happens in between."""

import contextlib
import errno
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import warnings

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption import encoding
from sb3_cgp.resumption import store as store_module
from sb3_cgp.resumption.store import BLOCK_FOLDERS, StateStore

ARRAYS = st_numpy.arrays(
    st.sampled_from([np.dtype(each) for each in ("f4", "f8", "i8", "u1", "?", "c16", ">f4", "f2")]),
    st_numpy.array_shapes(min_dims=0, min_side=0, max_side=4),
)
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.binary()
    | ARRAYS
    | st.sampled_from([np.float32(1.5), np.int64(-3), np.bool_(True)])
    | st.sampled_from([th.ones(2, 3), th.tensor(1.5, dtype=th.bfloat16), th.tensor([], dtype=th.long), th.tensor([True])])
)
TREES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=5) | st.integers(), inner, max_size=3)
    ),
    max_leaves=10,
)


def assert_same(found, expected):
    """Compare to the bit, types included."""
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        assert [type(key) for key in found] == [type(key) for key in expected]
        found, expected = list(found.values()), list(expected.values())
    if isinstance(expected, (list, tuple)):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    elif isinstance(expected, th.Tensor):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        assert th.equal(found, expected)
    elif isinstance(expected, (np.ndarray, np.generic)):
        assert (found.dtype.newbyteorder("="), found.shape) == (expected.dtype.newbyteorder("="), expected.shape)
        assert np.array_equal(found, expected, equal_nan=expected.dtype.kind in "fc")
    else:
        assert repr(found) == repr(expected)


@settings(deadline=None, max_examples=60)
@given(tree=st.dictionaries(st.text(max_size=5), TREES, max_size=4))
def test_what_was_saved_comes_back(tmp_path_factory, tree):
    folder = tmp_path_factory.mktemp("store")
    StateStore(folder).save(7, tree)
    step, found = StateStore(folder).load()
    assert step == 7
    assert_same(found, tree)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"a": {"b": [1, object()]}}, r"state\.a\.b\[1\] is a object, which a training state cannot hold"),
        ({"a": lambda: None}, r"state\.a is a function"),
        ({"a": np.array([None])}, r"state\.a is a ndarray"),
        ({"a": {1.5: 2}}, r"state\.a has the key 1\.5, but keys must be strings or integers"),
    ],
)
def test_what_is_not_data_is_refused_by_its_place(tmp_path, state, message):
    with pytest.raises(TypeError, match=message):
        StateStore(tmp_path).save(1, state)
    assert StateStore(tmp_path).steps() == []


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (0, 2, 1)])
def test_arrays_keep_their_order_in_memory(axes, tmp_path):
    """In which NumPy adds numbers, so that sums are the same to the bit."""
    array = np.random.default_rng(0).normal(size=(3, 4, 5)).transpose(axes).copy(order="K")
    StateStore(tmp_path).save(1, {"array": array, "one": np.asfortranarray(np.ones((1, 4)))})
    _, state = StateStore(tmp_path).load()
    assert state["array"].strides == array.strides
    assert np.array_equal(state["array"], array)
    assert state["one"].shape == (1, 4)


def test_only_what_has_changed_of_a_large_array_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(encoding, "BLOCK_BYTES", 2**16)
    written = []

    def write(path, content):
        written.append((path.name, len(content)))
        write_atomically(path, content)

    monkeypatch.setattr(store_module, "write_atomically", write)
    rows = np.random.default_rng(0).standard_normal((40_000, 4), dtype=np.float32)  # ten blocks
    store = StateStore(tmp_path)
    # To one folder, and to the other
    for step in (1, 2):
        store.save(step, {"rows": rows})
        assert sum(size == 2**16 for _, size in written) == 9
        written.clear()
    for step in (3, 4):
        rows[:400] += 1
        store.save(step, {"rows": rows})
        # A block, what small arrays share, and the manifest
        assert [size for _, size in written if size == 2**16] == [2**16]
        assert len(written) <= 3
        written.clear()
        assert_same(StateStore(tmp_path).load()[1], {"rows": rows})


def test_blocks_that_vanish_or_shrink_under_a_training_are_written_again(tmp_path):
    store = StateStore(tmp_path)
    for step in (1, 2):
        store.save(step, state_of(0))
    first, second = sorted((tmp_path / "blocks-0").iterdir())[:2]
    first.unlink()
    second.write_bytes(b"")
    store.save(3, state_of(0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert StateStore(tmp_path).load()[0] == 3


def test_what_was_verified_once_is_not_read_again(tmp_path, monkeypatch):
    store = StateStore(tmp_path)
    for step in (1, 2):
        store.save(step, state_of(0))
    read = []
    read_bytes = store_module.Path.read_bytes
    monkeypatch.setattr(store_module.Path, "read_bytes", lambda path: read.append(path) or read_bytes(path))
    store.save(3, state_of(0))
    assert read
    assert all(path.suffix == ".json" for path in read)


def state_of(step):
    generator = np.random.default_rng(step)
    arrays = {"large": generator.random(20_000), "small": generator.random(3), "same": np.arange(30_000)}
    return {"step": step, "text": "é", **arrays}


def test_the_newest_are_kept_and_nothing_that_no_state_needs(tmp_path):
    store = StateStore(tmp_path, keep=2)
    for step in (1, 2, 3):
        store.save(step, state_of(step))
    assert store.steps() == [2, 3]
    # Two large arrays, and what small ones share
    assert [len(list((tmp_path / blocks).iterdir())) for blocks in BLOCK_FOLDERS] == [3, 3]
    store.save(2, state_of(2))
    assert store.steps() == [2]
    assert sum(len(list((tmp_path / blocks).iterdir())) for blocks in BLOCK_FOLDERS) == 3


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"so that this was not written: '.*file/"):
        StateStore(tmp_path / "file").prepare()
    StateStore(tmp_path / "new").prepare()
    assert list((tmp_path / "new").iterdir()) == []


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path))):
        StateStore(tmp_path).load()


def damages(content):
    """List the ways in which a file's content may be damaged."""
    yield None
    # Among them the ends of the parts of a state's own file: its checksum, and its content
    for length in (0, 1, 12, 76, 86, len(content) // 2, len(content) - 2, len(content) - 1):
        if length < len(content):
            yield content[:length]
    yield content + b"x"
    for place in sorted({0, 1, 5, len(content) // 3, len(content) // 2, len(content) - 2, len(content) - 1}):
        for bit in (0, 7):
            flipped = bytearray(content)
            flipped[place] ^= 1 << bit
            yield bytes(flipped)


def test_every_damaged_file_is_refused_by_name_and_the_older_state_is_used(tmp_path):
    intact = tmp_path / "intact"
    StateStore(intact).save(1, state_of(1))
    olds = {path.relative_to(intact) for path in intact.rglob("*")}
    StateStore(intact).save(2, state_of(2))
    news = [path.relative_to(intact) for path in intact.rglob("*") if path.is_file() and path.relative_to(intact) not in olds]
    # The state's own file, two large arrays, one of them the same as before, and what small ones share
    assert len(news) == 4
    for name in news:
        for number, content in enumerate(damages((intact / name).read_bytes())):
            folder = tmp_path / f"{name.name}-{number}"
            shutil.copytree(intact, folder)
            if content is None:
                (folder / name).unlink()
            else:
                (folder / name).write_bytes(content)
            if not (folder / name).exists() and name.suffix == ".json":
                # No trace of it is left
                assert StateStore(folder).load()[0] == 1
                continue
            with pytest.warns(UserWarning, match=rf"Damaged: .*{name.name}: .*The older state of step 1 is used"):
                step, found = StateStore(folder).load()
            assert step == 1
            assert_same(found, state_of(1))
            # The training goes on from there, to where it was and beyond
            StateStore(folder).save(2, state_of(2))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                assert_same(StateStore(folder).load()[1], state_of(2))
            (folder / "state-000000000001.json").unlink(missing_ok=True)
            shutil.rmtree(folder)


def test_where_all_are_damaged_all_are_named(tmp_path):
    for step in (1, 2):
        StateStore(tmp_path).save(step, state_of(step))
        with open(tmp_path / f"state-{step:012d}.json", "ab") as file:
            file.write(b" ")
    with pytest.raises(ValueError, match=r"No state in .*: .*state-000000000002\.json.*; .*state-000000000001\.json"):
        StateStore(tmp_path).load()


@pytest.mark.parametrize("name", ["../../secret", "../../" + "0" * 64, "/etc/passwd", "A" * 64, "0" * 63])
def test_a_manifest_reaches_nothing_outside_of_its_folder(tmp_path, monkeypatch, name):
    StateStore(tmp_path).save(1, state_of(1))
    body = StateStore(tmp_path)._read_manifest(1)
    text = json.dumps(body)
    digest = next(iter(encoding.iter_digests(body["state"])))
    content = text.replace(digest, name)
    checksum = hashlib.sha256(content.encode()).hexdigest()
    (tmp_path / "state-000000000001.json").write_text(f'{{"sha256": "{checksum}", "body": {content}}}\n')
    opened = []
    read_bytes = store_module.Path.read_bytes
    monkeypatch.setattr(store_module.Path, "read_bytes", lambda path: opened.append(path) or read_bytes(path))
    with pytest.raises(ValueError, match=r"No state in .* is undamaged"):
        StateStore(tmp_path).load()
    assert all(tmp_path in path.resolve().parents for path in opened)


class Killed(BaseException):
    """What no code handles."""


def test_a_manifest_names_no_other_folder(tmp_path):
    StateStore(tmp_path).save(1, state_of(1))
    path = tmp_path / "state-000000000001.json"
    content = path.read_text()[86:-2].replace('"blocks-0"', '"../blocks"')
    path.write_text(f'{{"sha256": "{hashlib.sha256(content.encode()).hexdigest()}", "body": {content}}}\n')
    with pytest.raises(ValueError, match=r"its blocks are not in one of blocks-0, blocks-1"):
        StateStore(tmp_path).load()


@pytest.mark.parametrize("keep", [1, 2])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), Killed()])
def test_whichever_operation_fails_a_whole_state_remains(tmp_path, monkeypatch, failure, keep):
    """Let the first file operation fail, then the second, and so on, until a save has no more of them."""
    number = 0
    while True:
        folder = tmp_path / str(number)
        StateStore(folder).save(1, state_of(1))
        left = [number]

        def failing(function, left=left):
            def call(*args, **kwargs):
                left[0] -= 1
                if left[0] == -1:
                    raise failure
                return function(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            for name in ("fsync", "replace", "unlink", "open"):
                patch.setattr(os, name, failing(getattr(os, name)))
            patch.setattr("builtins.open", failing(open))
            # Not every failure ends the saving: what is left over may stay
            with contextlib.suppress(type(failure)):
                StateStore(folder, keep).save(2, state_of(2))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            step, found = StateStore(folder).load()
        assert_same(found, state_of(step))
        StateStore(folder, keep).save(3, state_of(3))
        assert not [path for path in folder.rglob("*") if "partial" in path.name]
        assert len(list(folder.glob("blocks-?/*"))) == 3 * keep
        number += 1
        if left[0] >= 0:
            break
    assert number > 12


FULL_DISK = """
    import sys
    import numpy as np
    from sb3_cgp.resumption.store import StateStore
    store = StateStore(sys.argv[1] + "/state")
    store.save(1, {"rows": np.zeros(50_000)})
    try:
        store.save(2, {"rows": np.random.default_rng(0).random(150_000)})
    except OSError as error:
        assert error.errno == 28 and sys.argv[1] in error.filename, error
    else:
        raise AssertionError("the disk is not full")
    step, state = StateStore(sys.argv[1] + "/state").load()
    assert step == 1 and state["rows"].shape == (50_000,)
"""


def test_a_full_disk_leaves_the_older_state(tmp_path):
    mounted = f'mount -t tmpfs -o size=1m tmpfs "{tmp_path}" || exit 77; exec "$@"'
    namespace = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mounted, "sh"]
    script = [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path)]
    if shutil.which("unshare") is None or subprocess.run([*namespace, "true"], capture_output=True).returncode != 0:
        pytest.skip("needs the right to mount a small disk")
    subprocess.run([*namespace, *script], check=True)


def test_killed_while_saving(tmp_path):
    """A process that does nothing but save is killed at random moments."""
    draw = random.Random(0)
    newest = 0
    for _ in range(30):
        child = os.fork()
        if child == 0:
            try:
                step = max(StateStore(tmp_path).steps(), default=0)
                while True:
                    step += 1
                    StateStore(tmp_path).save(step, state_of(step))
            finally:
                os._exit(1)
        # However slow the machine is, it gets further
        while max(StateStore(tmp_path).steps(), default=0) <= newest:
            time.sleep(0.001)
        time.sleep(draw.uniform(0.0, 0.1))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            step, found = StateStore(tmp_path).load()
        assert step > newest
        newest = step
        assert_same(found, state_of(step))
    assert newest >= 30
    StateStore(tmp_path).save(newest + 1, state_of(newest + 1))
    assert not list(tmp_path.rglob(".partial*"))
