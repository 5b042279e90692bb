"""The effects of the contract's section 6, one a file."""
