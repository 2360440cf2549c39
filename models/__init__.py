"""Model plugins: one file, one model."""
