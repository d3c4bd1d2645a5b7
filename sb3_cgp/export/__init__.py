"""Exporting a policy to ONNX, safetensors and JSON, and loading it without pickle. It needs the extra ``export``."""
