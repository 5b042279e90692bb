"""The next experiment: what would separate the causes that are left."""
