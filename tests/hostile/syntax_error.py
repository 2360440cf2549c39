"""Is no Python."""

def fit(:
