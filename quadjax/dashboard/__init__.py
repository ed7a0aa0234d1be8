"""What the pages show: flights of any source, training runs while they train, and sweeps."""
