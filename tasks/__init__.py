"""Task plugins: one file, one protocol."""
