"""Holds the world against closed forms and independent codes (floor 3): `dlobench validate`."""
