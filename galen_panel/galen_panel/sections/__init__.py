"""The parts of the page, one a file: `build(page)` draws it and says how it follows the state."""
