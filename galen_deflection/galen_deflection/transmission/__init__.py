"""One joint or transmission: how far its load's end stays behind its motor's end."""
