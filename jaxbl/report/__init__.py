"""Figures and reports, each in a module of its own: a command loads what it writes."""
