"""One function over many bags, in parallel."""
