"""The bench of hidden effects: its own truth simulator, its cases, its scores. Run by benchmarks/hidden_effects.py."""
