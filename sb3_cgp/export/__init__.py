"""Exporting a policy, and loading an exported policy without pickle."""
