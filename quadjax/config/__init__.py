"""Configs: schema, loading, validation."""
