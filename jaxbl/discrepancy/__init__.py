"""A measured log against a model: where they disagree, which effect is missing, and proof that adding it helps."""
