"""
Loading an exported policy from safetensors and JSON, which hold data and no code.

The files may come from an unknown source, see :mod:`sb3_cgp.export.description` and :mod:`sb3_cgp.export.boxes`.
"""

import errno
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch as th

from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.common.spaces import check_action_space
from sb3_cgp.export.boxes import ACTION_DTYPES, boxes_of, read_box, read_observations
from sb3_cgp.export.description import DESCRIPTION_FILE, ONNX_FILE, TENSORS_FILE, check_description, make_actor
from sb3_cgp.export.normalization import make_normalizers, normalized_names, statistics_names
from sb3_cgp.export.policy import ExportedNetwork, ExportedPolicy

# For the error where a package of the extra is missing
PURPOSE = "Exporting policies and loading them"


def _check_tensors(tensors: Mapping[str, th.Tensor], expected: Mapping[str, th.Tensor]) -> None:
    """Check the names, shapes and data types of tensors, and that they are finite."""
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or extra:
        raise ValueError(f"The tensors do not belong to this network: missing are {missing}, and too many {extra}.")
    # In the network's order, because that of safetensors varies
    for name, value in expected.items():
        tensor = tensors[name]
        found, wanted = (f"{each.dtype} of shape {tuple(each.shape)}" for each in (tensor, value))
        if found != wanted:
            raise ValueError(f"The tensor {name} is {found}, but must be {wanted}.")
        if not bool(th.isfinite(tensor).all()):
            raise ValueError(f"The tensor {name} holds NaN or infinite values.")


def build(description: Mapping[str, Any], tensors: Mapping[str, th.Tensor]) -> ExportedPolicy:
    """
    Build a policy from its description and tensors.

    :param description: the content of ``policy.json``
    :param tensors: the network's parameters and buffers, and the statistics of the observations, by name
    :return: the policy
    :raises ValueError: naming an entry or tensor that is not allowed, or does not fit the others
    """
    observation_space = read_observations(description["observation_space"], "observation_space")
    action_space = read_box(description["action_space"], "action_space", ACTION_DTYPES)
    check_action_space(action_space)
    actor = make_actor(description["network"], observation_space, action_space)
    normalization = description["normalization"]
    normalized = normalized_names(normalization, observation_space)
    expected: dict[str, th.Tensor] = {}
    for name in normalized:
        statistics = th.empty(boxes_of(observation_space)[name].shape, dtype=th.float64, device="meta")
        expected |= dict.fromkeys(statistics_names(observation_space, name), statistics)
    _check_tensors(tensors, expected | actor.state_dict())
    normalizers = make_normalizers(normalization, normalized, observation_space, tensors)
    actor.load_state_dict({name: tensors[name] for name in actor.state_dict()}, assign=True)
    network = ExportedNetwork(actor, observation_space, action_space, normalizers).eval().requires_grad_(False)
    return ExportedPolicy(network, observation_space, action_space, description)


@contextmanager
def _refusing(path: Path, *errors: type[Exception]) -> Iterator[None]:
    """Turn errors about the content of a file into errors that name the file."""
    # RecursionError: JSON nested too deep. OverflowError: numbers beyond the range of a data type
    caught: tuple[type[Exception], ...] = (ValueError, RecursionError, OverflowError, *errors)
    try:
        yield
    except caught as error:
        raise ValueError(f"{path} was refused: {error}") from error


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def load_weights(folder: str | Path) -> ExportedPolicy:
    """
    Load the policy that was exported to a folder, without pickle and without running code from the files.

    Of ``policy.onnx`` only the checksum is compared; the file may be missing.

    :param folder: the folder
    :return: the policy
    :raises ValueError: if a file is damaged or of another export, or an entry is not allowed; it names the file and the reason
    :raises FileNotFoundError: if ``policy.json`` or ``policy.safetensors`` is missing
    :raises NotADirectoryError: if the folder is a file
    :raises ImportError: if safetensors is not installed
    """
    if Path(folder).is_file():
        raise NotADirectoryError(
            errno.ENOTDIR, "Is a file, and no folder that `export` wrote; `load` reads a model", str(folder)
        )
    model = Path(f"{Path(folder)}.zip")
    if not Path(folder).exists() and model.is_file():
        raise FileNotFoundError(errno.ENOENT, f"There is no exported policy; `load` reads the model {model}", str(folder))
    safetensors = import_from_extra("safetensors", "export", PURPOSE)
    safetensors_torch = import_from_extra("safetensors.torch", "export", PURPOSE)
    paths = {name: Path(folder) / name for name in (DESCRIPTION_FILE, TENSORS_FILE, ONNX_FILE)}
    with _refusing(paths[DESCRIPTION_FILE]):
        description = json.loads(paths[DESCRIPTION_FILE].read_bytes(), parse_constant=_refuse_constant)
        check_description(description)
    content = paths[TENSORS_FILE].read_bytes()
    contents = {TENSORS_FILE: content}
    if paths[ONNX_FILE].exists():
        contents[ONNX_FILE] = paths[ONNX_FILE].read_bytes()
    for name, bytes_read in contents.items():
        with _refusing(paths[name]):
            if hashlib.sha256(bytes_read).hexdigest() != description["sha256"][name]:
                raise ValueError(f"its checksum is not the one in {DESCRIPTION_FILE}: it is damaged or of another export")
    with _refusing(paths[TENSORS_FILE], safetensors.SafetensorError, KeyError, RuntimeError, TypeError):
        tensors = safetensors_torch.load(content)
    # If the description and the tensors do not fit together, the error names the description
    with _refusing(paths[DESCRIPTION_FILE], TypeError):
        return build(description, tensors)
