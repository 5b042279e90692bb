"""The arm that `blind_check` records: its own code and other laws than the diagnosis fits.

Nothing in here may import the simulator's effects, its replay or the diagnosis; a test holds that.
"""
