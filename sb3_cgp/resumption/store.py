"""
A folder of training states: each as a whole or not at all, verified when read, and nothing written twice.

``state-<step>.json`` holds a state's plain data. Arrays lie in a folder of blocks, files called by the SHA-256 of what they
hold, so that states share what they have in common: a replay buffer is in every state, and what has changed of it is written.
There are two such folders, and states take them in turn: no damage to one file can take two states that follow each other.
Nothing is pickled.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_cgp.common.files import PARTIAL, write_atomically

FORMAT = "sb3_cgp training state"
FORMAT_VERSION = 2
BLOCK_FOLDERS = ("blocks-0", "blocks-1")
# Of an array
BLOCK_BYTES = 2**22
# Arrays below it share blocks
SMALL_BYTES = 2**16
DIGEST = re.compile("[0-9a-f]{64}")
ARRAY_KINDS = "biufc"


class DamagedStateError(ValueError):
    """
    A file of a state is not what was written.

    :param path: the file
    :param reason: what is wrong with it
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

    :param folder: the folder; it is made when the first state is saved
    :param keep: how many states to keep, at least 1. If it is 1, only one of the folders of blocks is used.
    """

    def __init__(self, folder: str | Path, keep: int = 2):
        self.folder = Path(folder)
        self.keep = keep
        # Written or read and verified by this process
        self._good_blocks: set[Path] = set()

    def prepare(self) -> None:
        """
        Make the folder, and see that states can be written to it.

        :raises OSError: if they cannot, naming the file
        """
        attempt = self.folder / f"{PARTIAL}attempt"
        write_atomically(attempt, b"")
        attempt.unlink()

    def steps(self) -> list[int]:
        """
        List the states, damaged ones too.

        :return: their steps, ascending
        """
        found = (re.fullmatch(r"state-(\d{12})\.json", path.name) for path in self.folder.glob("state-*.json"))
        return sorted(int(match[1]) for match in found if match)

    def save(self, step: int, state: Mapping[str, Any]) -> None:
        """
        Save a state, and remove the oldest ones beyond those to keep.

        Of states of later steps nothing is kept: they are ones that were damaged when the training was resumed.

        :param step: the state's step
        :param state: the state
        :raises TypeError: if something in it is not plain data, naming where it is
        :raises OSError: if it cannot be written, naming the file; older states are still there
        """
        blocks = self._next_block_folder(step)
        writer = _Writer(self, blocks)
        tree = writer.encode(dict(state), "state")
        writer.flush()
        body = {"format": FORMAT, "version": FORMAT_VERSION, "step": step, "blocks": blocks, "state": tree}
        content = json.dumps(body)
        digest = hashlib.sha256(content.encode()).hexdigest()
        write_atomically(self._manifest(step), f'{{"sha256": "{digest}", "body": {content}}}\n'.encode())
        self._prune(step)

    def load(self) -> tuple[int, dict[str, Any]]:
        """
        Load the newest state of which nothing is damaged. Others are named in a warning.

        :return: its step, and the state
        :raises FileNotFoundError: if there is no state
        :raises NoStateLeftError: if all are damaged, naming their files
        """
        damaged: list[str] = []
        for step in reversed(self.steps()):
            try:
                body = self._read_manifest(step)
                state = _Reader(self, body["blocks"]).decode(body["state"])
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
        """Choose where a state's blocks go: not where those of the one before it are, so that one of them survives damage."""
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
        """Whether a block is there, and what it ought to be."""
        path = self._block(blocks, digest)
        try:
            if path in self._good_blocks:
                # A look suffices, as its content was verified: there may be gigabytes of them
                return path.stat().st_size == size
            self._read_block(blocks, digest)
        except (DamagedStateError, FileNotFoundError):
            return False
        return True

    def _read_block(self, blocks: str, digest: str) -> bytes:
        path = self._block(blocks, digest)
        if not DIGEST.fullmatch(digest):
            raise DamagedStateError(path, "it is not called by a checksum")
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
        """Remove what is not needed any more; a failure does no harm, and the next time makes up for it."""
        steps = self.steps()
        kept = [each for each in steps if each <= step][-self.keep :]
        for each in set(steps) - set(kept):
            self._manifest(each).unlink(missing_ok=True)
        needed: set[Path] = set()
        for each in kept:
            try:
                body = self._read_manifest(each)
            except DamagedStateError:
                # Which blocks it needs is not known
                return
            needed.update(self._block(body["blocks"], digest) for digest in _digests(body["state"]))
        folders = [self.folder / name for name in BLOCK_FOLDERS]
        blocks = [path for folder in folders if folder.is_dir() for path in folder.iterdir()]
        for path in (*self.folder.glob(f"{PARTIAL}*"), *blocks):
            if path not in needed:
                path.unlink(missing_ok=True)
        self._good_blocks &= needed


class _Writer:
    """
    Makes JSON of a state, and writes its arrays.

    :param store: where to
    :param blocks: the folder of its blocks
    """

    def __init__(self, store: StateStore, blocks: str):
        self._store, self._blocks = store, blocks
        self._small = bytearray()
        # Their references, which learn of their block when it is written
        self._waiting: list[dict[str, Any]] = []

    def encode(self, value: Any, place: str) -> Any:
        """Make JSON of a value: itself, or a dictionary that says what it is."""
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            # JSON has no infinities
            return {"float": value.hex()}
        if type(value) is dict:
            items = [[self._encode_key(key, place), self.encode(each, f"{place}.{key}")] for key, each in value.items()]
            return {"dict": items}
        if type(value) in (list, tuple):
            return {type(value).__name__: [self.encode(each, f"{place}[{index}]") for index, each in enumerate(value)]}
        if type(value) is bytes:
            return {"bytes": self._refer(memoryview(value))}
        if isinstance(value, th.Tensor):
            plain = value.detach().cpu().contiguous()
            return {"tensor": str(plain.dtype), "shape": list(plain.shape), **self._refer(_bytes_of_tensor(plain))}
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in ARRAY_KINDS:
            kind = "array" if isinstance(value, np.ndarray) else "scalar"
            array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
            return {kind: value.dtype.newbyteorder("<").str, "shape": list(value.shape), **self._refer(_bytes_of(array))}
        raise TypeError(f"{place} is a {type(value).__name__}, which a training state cannot hold.")

    def _encode_key(self, key: Any, place: str) -> Any:
        if type(key) in (str, int):
            return key
        raise TypeError(f"{place} has the key {key!r}, but keys must be strings or integers.")

    def _refer(self, content: memoryview) -> dict[str, Any]:
        """Write bytes, and say where they are."""
        if content.nbytes >= SMALL_BYTES:
            blocks = [content[start : start + BLOCK_BYTES] for start in range(0, content.nbytes, BLOCK_BYTES)]
            return {"size": content.nbytes, "blocks": [self._store._write_block(self._blocks, block) for block in blocks]}
        reference: dict[str, Any] = {"size": content.nbytes, "start": len(self._small), "blocks": []}
        self._small += content
        self._waiting.append(reference)
        return reference

    def flush(self) -> None:
        """Write what small arrays share."""
        digest = self._store._write_block(self._blocks, memoryview(self._small))
        for reference in self._waiting:
            reference["blocks"].append(digest)


class _Reader:
    """
    Makes a state of JSON, and reads its arrays.

    :param store: where from
    :param blocks: the folder of its blocks
    """

    def __init__(self, store: StateStore, blocks: str):
        self._store, self._blocks = store, blocks
        self._shared: dict[str, bytes] = {}

    def decode(self, value: Any) -> Any:
        """Undo :meth:`_Writer.encode`."""
        if not isinstance(value, dict):
            return value
        if "float" in value:
            return float.fromhex(value["float"])
        if "dict" in value:
            return {key: self.decode(each) for key, each in value["dict"]}
        for kind in (list, tuple):
            if kind.__name__ in value:
                return kind(self.decode(each) for each in value[kind.__name__])
        if "bytes" in value:
            return bytes(self._read(value["bytes"]))
        content = self._read(value)
        if "tensor" in value:
            dtype = getattr(th, value["tensor"].removeprefix("torch."))
            flat = th.frombuffer(content, dtype=dtype) if content else th.empty(0, dtype=dtype)
            return flat.reshape(value["shape"])
        dtype = np.dtype(value.get("array") or value["scalar"])
        array = np.frombuffer(content, dtype).reshape(value["shape"])
        return array if "array" in value else array[()]

    def _read(self, reference: dict[str, Any]) -> bytearray:
        """Read and verify bytes."""
        size, digests = reference["size"], reference["blocks"]
        if "start" in reference:
            (digest,) = digests
            if digest not in self._shared:
                self._shared[digest] = self._store._read_block(self._blocks, digest)
            return bytearray(self._shared[digest][reference["start"] : reference["start"] + size])
        content = bytearray()
        for digest in digests:
            content += self._store._read_block(self._blocks, digest)
        return content


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _bytes_of_tensor(tensor: th.Tensor) -> memoryview:
    return tensor.reshape(-1).view(th.uint8).numpy().data


def _digests(value: Any) -> Iterator[str]:
    """List the blocks that a state needs."""
    if isinstance(value, dict):
        yield from value.get("blocks", ())
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from _digests(each)
