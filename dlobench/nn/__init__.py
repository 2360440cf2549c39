"""Holds what learned plugins share: windows, networks, fits."""
