"""Defines none."""

MODEL = None
