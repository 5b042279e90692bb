"""The page: header, tabs and elements."""
