"""Drives with backlash, thousands at once."""
