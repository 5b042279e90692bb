"""The arm as springs: compliance, hysteresis, creep."""
