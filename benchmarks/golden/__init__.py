"""Goldens: results of one commit beside those of the working tree. Run by benchmarks/goldens.py."""
