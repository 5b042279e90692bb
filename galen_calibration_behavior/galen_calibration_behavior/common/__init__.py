"""What the procedures share: commands, parameters, the check's decision."""
