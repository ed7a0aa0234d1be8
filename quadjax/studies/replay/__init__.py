"""A flight log replayed through a policy and a model."""
