"""Rest segments: where the arm stands still and the wrench is steady."""
