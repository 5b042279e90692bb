"""Recurrent networks: trained with PyTorch, run without it."""

NEEDS = "needs PyTorch and safetensors: `make networks` installs them"
"""What is said where one of them lacks."""
