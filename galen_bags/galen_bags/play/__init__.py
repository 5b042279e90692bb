"""Publishing a bag again."""
