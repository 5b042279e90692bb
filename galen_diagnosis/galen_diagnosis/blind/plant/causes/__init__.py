"""Causes of the contract's section 6, and others that aren't on its list."""
