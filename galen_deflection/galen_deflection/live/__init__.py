"""A model on live samples."""
