"""Makes the environment and builds the workspace; only the standard library is used."""
