"""Recurrent networks: trained with PyTorch, run without it."""
