"""The pull of a cable at the tool."""
