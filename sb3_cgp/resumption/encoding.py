"""Encoding training states as JSON and blocks of bytes. It pickles nothing; the model, SB3's zip, is bytes to it."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th

# Size of the blocks of an array
BLOCK_BYTES = 2**22
# Smaller arrays share a block
SMALL_BYTES = 2**16
ARRAY_KINDS = "biufc"


class Encoder:
    """
    Encode a state as JSON, and write its arrays as blocks.

    :param write_block: writes a block and returns its digest
    """

    def __init__(self, write_block: Callable[[memoryview], str]):
        self._write_block = write_block
        self._small = bytearray()
        # References to small arrays whose block has not been written
        self._waiting: list[dict[str, Any]] = []

    def encode(self, value: Any, place: str) -> Any:
        """
        Encode a value as JSON: as itself, or as a dictionary that names its type.

        :param value: the value
        :param place: its place in the state, for the error
        :return: data that JSON can hold
        :raises TypeError: if the value, or a part of it, is not plain data
        """
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
            # The order in memory, from the outermost axis to the innermost, in which NumPy adds numbers
            axes = [] if value.flags.c_contiguous else sorted(range(value.ndim), key=lambda axis: -abs(value.strides[axis]))
            value = np.transpose(value, axes) if axes else value
            array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
            order = {"axes": axes} if axes else {}
            shape = list(value.shape)
            return {kind: value.dtype.newbyteorder("<").str, "shape": shape, **order, **self._refer(_bytes_of(array))}
        raise TypeError(f"{place} is a {type(value).__name__}, which a training state cannot hold.")

    def _encode_key(self, key: Any, place: str) -> Any:
        if type(key) in (str, int):
            return key
        raise TypeError(f"{place} has the key {key!r}, but keys must be strings or integers.")

    def _refer(self, content: memoryview) -> dict[str, Any]:
        """Write bytes, and return a reference to their blocks."""
        if content.nbytes >= SMALL_BYTES:
            blocks = [content[start : start + BLOCK_BYTES] for start in range(0, content.nbytes, BLOCK_BYTES)]
            return {"size": content.nbytes, "blocks": [self._write_block(block) for block in blocks]}
        reference: dict[str, Any] = {"size": content.nbytes, "start": len(self._small), "blocks": []}
        self._small += content
        self._waiting.append(reference)
        return reference

    def flush(self) -> None:
        """Write the block that small arrays share."""
        digest = self._write_block(memoryview(self._small))
        for reference in self._waiting:
            reference["blocks"].append(digest)


class Decoder:
    """
    Decode a state from JSON, and read its arrays from blocks.

    :param read_block: reads and verifies the block of a digest
    """

    def __init__(self, read_block: Callable[[str], bytes]):
        self._read_block = read_block
        self._shared: dict[str, bytes] = {}

    def decode(self, value: Any) -> Any:
        """
        Decode the value that :meth:`Encoder.encode` encoded.

        :param value: data from JSON
        :return: the value
        """
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
        if "axes" in value:
            array = array.transpose(np.argsort(value["axes"]))
        return array if "array" in value else array[()]

    def _read(self, reference: dict[str, Any]) -> bytearray:
        """Read and verify bytes."""
        size, digests = reference["size"], reference["blocks"]
        if "start" in reference:
            (digest,) = digests
            if digest not in self._shared:
                self._shared[digest] = self._read_block(digest)
            return bytearray(self._shared[digest][reference["start"] : reference["start"] + size])
        content = bytearray()
        for digest in digests:
            content += self._read_block(digest)
        return content


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _bytes_of_tensor(tensor: th.Tensor) -> memoryview:
    return tensor.reshape(-1).view(th.uint8).numpy().data


def iter_digests(value: Any) -> Iterator[str]:
    """
    List the blocks that an encoded state needs.

    :param value: data from JSON
    :return: the blocks' digests
    """
    if isinstance(value, dict):
        yield from value.get("blocks", ())
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from iter_digests(each)
