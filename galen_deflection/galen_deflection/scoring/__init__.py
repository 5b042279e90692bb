"""Training, scores and comparison of models."""
