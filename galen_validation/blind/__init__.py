"""The blind check: recordings with a hidden cause, sealed labels, scores."""
