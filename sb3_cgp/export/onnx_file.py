"""The ONNX of an exported policy: one named input for each box of observations, one output."""

import logging
import warnings
from typing import Any

import numpy as np
import torch as th

from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.export.boxes import ACTION, ObservationSpace, boxes_of
from sb3_cgp.export.policy import ExportedNetwork
from sb3_cgp.export.read import PURPOSE

# The newest opset that PyTorch's exporter writes without a conversion; runtimes since 2023 read it
OPSET = 18


def make_onnx(network: ExportedNetwork, inputs: dict[str, np.ndarray]) -> bytes:
    """
    Write a network as ONNX, for batches of any size.

    :param network: the network
    :param inputs: a batch of observations for each input, by name
    :return: the content of the ONNX file
    :raises ImportError: if onnx is not installed
    """
    # No key of observations has a full stop: these names and those of the values in the graph are none of theirs
    temporary = [f"input.{index}" for index, _ in enumerate(inputs)]
    proto = _export(network, inputs, temporary)
    # PyTorch writes the source of each node, with paths of the user's machine
    proto.graph.ClearField("metadata_props")
    for part in (
        *proto.graph.node,
        *proto.graph.value_info,
        *proto.graph.initializer,
        *proto.graph.input,
        *proto.graph.output,
    ):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    import_from_extra("onnx.compose", "export", PURPOSE).add_prefix_graph(
        proto.graph,
        "policy.",
        rename_inputs=False,
        rename_outputs=False,
        inplace=True,
        name_map=dict(zip(temporary, inputs, strict=True)),
    )
    return bytes(proto.SerializeToString())


def run_onnx(content: bytes, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """
    Return the actions of a policy in onnxruntime, on the CPU.

    :param content: the content of the ONNX file
    :param inputs: a batch of observations for each input, by name
    :return: the actions
    :raises ImportError: if onnxruntime is not installed
    """
    onnxruntime = import_from_extra("onnxruntime", "export", PURPOSE)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([ACTION], inputs)[0])


def named_inputs(space: ObservationSpace, observations: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    Return observations by the names of the ONNX inputs, in the order of the network's arguments.

    :param space: the observation space
    :param observations: a batch, or one for each key of a Dict space
    :return: the batches
    """
    names = list(boxes_of(space))
    return {name: observations[name] for name in names} if isinstance(observations, dict) else {names[0]: observations}


def _export(network: ExportedNetwork, inputs: dict[str, np.ndarray], names: list[str]) -> Any:
    """Return PyTorch's ONNX model of a network whose inputs have the given names."""
    registration = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registration.level
    # Without torchvision, the exporter warns of each of its operators; it also warns of deprecated functions of PyTorch
    registration.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            batch = th.export.Dim("batch")
            program = th.onnx.export(
                network,
                tuple(map(th.as_tensor, inputs.values())),
                dynamo=True,
                input_names=names,
                output_names=[ACTION],
                dynamic_shapes=(tuple({0: batch} for _ in names),),
                opset_version=OPSET,
                verbose=False,
            )
    finally:
        registration.setLevel(level)
    assert program is not None
    return program.model_proto
