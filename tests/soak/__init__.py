"""A soak: random clients against a live broker, every delivery checked against a model."""
