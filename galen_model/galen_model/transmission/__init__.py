"""One joint or transmission: readings of both ends, terms of its lag, plays."""
