"""Measures the friction of every pair of things that can touch: presses them together and draws one along the other."""
