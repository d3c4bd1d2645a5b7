"""
A folder of training states. A state is written completely or not at all, and is verified when it is read.

``state-<step>.json`` holds a state's plain data. Arrays lie in a folder of blocks, which are files named by the SHA-256 of
their content, so that states share equal blocks: of a replay buffer, only the changed blocks are written. There are two such
folders, which states use in turn: damage to one file cannot destroy two successive states.

Checksums show damage, not who wrote a state. The store unpickles nothing itself, but the model within a state is SB3's zip,
which ``resume`` unpickles: a stranger's state can run any code.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from sb3_cgp.common.files import PARTIAL, write_atomically
from sb3_cgp.resumption.encoding import Decoder, Encoder, iter_digests

FORMAT = "sb3_cgp training state"
FORMAT_VERSION = 3
BLOCK_FOLDERS = ("blocks-0", "blocks-1")
# Bytes of a manifest that hold its checksum
MANIFEST_PREFIX = 76
DIGEST = re.compile("[0-9a-f]{64}")


class DamagedStateError(ValueError):
    """
    A file of a state has been altered since it was written.

    :param path: the file
    :param reason: the damage
    """

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: {reason}")


class NoStateLeftError(ValueError):
    """All states of a folder are damaged."""


class StateStore:
    """
    The states of one training.

    A state is a tree of dictionaries (keys: strings, integers), lists, tuples, None, booleans, numbers, strings, bytes, NumPy
    arrays and scalars, and PyTorch tensors, which come back on the CPU.

    :param folder: the folder, which is created when the first state is saved
    :param keep: how many states to keep, at least 1. If it is 1, only one of the folders of blocks is used.
    """

    def __init__(self, folder: str | Path, keep: int = 2):
        self.folder = Path(folder)
        self.keep = keep
        # The blocks that this process has written or verified
        self._good_blocks: set[Path] = set()

    def prepare(self) -> None:
        """
        Make the folder, and check that files can be written to it.

        :raises OSError: if they cannot be written, naming the file
        """
        attempt = self.folder / f"{PARTIAL}attempt"
        write_atomically(attempt, b"")
        attempt.unlink()

    def steps(self) -> list[int]:
        """
        List the states, damaged ones included.

        :return: their steps, ascending
        """
        found = (re.fullmatch(r"state-(\d{12})\.json", path.name) for path in self.folder.glob("state-*.json"))
        return sorted(int(match[1]) for match in found if match)

    def digests(self) -> frozenset[str]:
        """
        Return the digests of the states, by which a training recognises its own states.

        :return: the step and the checksum of each state, unverified
        """
        found = set()
        for step in self.steps():
            with suppress(OSError), open(self._manifest(step), "rb") as file:
                found.add(f"{step} {file.read(MANIFEST_PREFIX).decode(errors='replace')}")
        return frozenset(found)

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """
        Save a state, and remove the oldest states beyond the number to keep.

        States of later steps are removed, too, as they were damaged when the training was resumed.

        :param step: the state's step
        :param state: the state
        :raises TypeError: if a part of the state is not plain data, naming its place in the state
        :raises OSError: if the state cannot be written, naming the file; older states are kept
        """
        blocks = self._next_block_folder(step)
        encoder = Encoder(partial(self._write_block, blocks))
        tree = encoder.encode(dict(state), "state")
        encoder.flush()
        body = {"format": FORMAT, "version": FORMAT_VERSION, "step": step, "blocks": blocks, "state": tree}
        content = json.dumps(body)
        digest = hashlib.sha256(content.encode()).hexdigest()
        write_atomically(self._manifest(step), f'{{"sha256": "{digest}", "body": {content}}}\n'.encode())
        self._prune(step)

    def load(self) -> tuple[int, dict[str, Any]]:
        """
        Load the newest undamaged state. A warning names the damaged files of newer states.

        :return: the state's step, and the state
        :raises FileNotFoundError: if the folder holds no state
        :raises NoStateLeftError: if all states are damaged, naming their files
        """
        damaged: list[str] = []
        for step in reversed(self.steps()):
            try:
                body = self._read_manifest(step)
                state = Decoder(partial(self._read_block, body["blocks"])).decode(body["state"])
            except DamagedStateError as error:
                damaged.append(str(error))
                continue
            if damaged:
                warnings.warn(f"Damaged: {'; '.join(damaged)}. The older state of step {step} is used.", stacklevel=2)
            return step, state
        if damaged:
            raise NoStateLeftError(f"No state in {self.folder} is undamaged: {'; '.join(damaged)}.")
        raise FileNotFoundError(f"There is no training state in {self.folder}.")

    def _manifest(self, step: int) -> Path:
        return self.folder / f"state-{step:012d}.json"

    def _next_block_folder(self, step: int) -> str:
        """Return the folder for a state's blocks. The previous state uses the other one: damage affects only one."""
        for each in reversed([each for each in self.steps() if each < step]):
            try:
                last = BLOCK_FOLDERS.index(self._read_manifest(each)["blocks"])
            except DamagedStateError:
                continue
            return BLOCK_FOLDERS[last if self.keep == 1 else 1 - last]
        return BLOCK_FOLDERS[0]

    def _read_manifest(self, step: int) -> dict[str, Any]:
        path = self._manifest(step)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DamagedStateError(path, f"it cannot be read ({error.strerror})") from error
        match = re.fullmatch(rb'\{"sha256": "([0-9a-f]{64})", "body": (.*)\}\n', content, re.DOTALL)
        if match is None or hashlib.sha256(match[2]).hexdigest() != match[1].decode():
            raise DamagedStateError(path, "its checksum is wrong: it was altered or cut short")
        body = json.loads(match[2])
        if (body.get("format"), body.get("version"), body.get("step")) != (FORMAT, FORMAT_VERSION, step):
            raise DamagedStateError(path, f"it is not version {FORMAT_VERSION} of a {FORMAT} of step {step}")
        if body["blocks"] not in BLOCK_FOLDERS:
            raise DamagedStateError(path, f"its blocks are not in one of {', '.join(BLOCK_FOLDERS)}")
        return body

    def _block(self, blocks: str, digest: str) -> Path:
        return self.folder / blocks / digest

    def _has_good_block(self, blocks: str, digest: str, size: int) -> bool:
        """Return whether an undamaged block exists."""
        path = self._block(blocks, digest)
        try:
            if path in self._good_blocks:
                # The content, which may be gigabytes, was verified before
                return path.stat().st_size == size
            self._read_block(blocks, digest)
        except (DamagedStateError, FileNotFoundError):
            return False
        return True

    def _read_block(self, blocks: str, digest: str) -> bytes:
        path = self._block(blocks, digest)
        if not DIGEST.fullmatch(digest):
            raise DamagedStateError(path, "its name is not a checksum")
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DamagedStateError(path, f"it cannot be read ({error.strerror})") from error
        if hashlib.sha256(content).hexdigest() != digest:
            raise DamagedStateError(path, "its checksum is wrong: it was altered or cut short")
        self._good_blocks.add(path)
        return content

    def _write_block(self, blocks: str, content: memoryview) -> str:
        digest = hashlib.sha256(content).hexdigest()
        if not self._has_good_block(blocks, digest, content.nbytes):
            write_atomically(self._block(blocks, digest), content)
            self._good_blocks.add(self._block(blocks, digest))
        return digest

    def _prune(self, step: int) -> None:
        """Remove the files that no kept state needs. Files that a failure leaves behind are removed by the next call."""
        steps = self.steps()
        kept = [each for each in steps if each <= step][-self.keep :]
        for each in set(steps) - set(kept):
            self._manifest(each).unlink(missing_ok=True)
        needed: set[Path] = set()
        for each in kept:
            try:
                body = self._read_manifest(each)
            except DamagedStateError:
                # The blocks of a damaged state are not known
                return
            needed.update(self._block(body["blocks"], digest) for digest in iter_digests(body["state"]))
        folders = [self.folder / name for name in BLOCK_FOLDERS]
        blocks = [path for folder in folders if folder.is_dir() for path in folder.iterdir()]
        for path in (*self.folder.glob(f"{PARTIAL}*"), *blocks):
            if path not in needed:
                path.unlink(missing_ok=True)
        self._good_blocks &= needed
