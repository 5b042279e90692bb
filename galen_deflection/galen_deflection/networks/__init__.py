"""Recurrent networks: trained with PyTorch, run without it."""

NEEDS = "needs PyTorch and safetensors: `make networks` installs them"
"""The remedy where one of them is missing."""
