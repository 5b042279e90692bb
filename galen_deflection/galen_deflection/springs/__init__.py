"""The arm as springs: compliance and hysteresis."""
