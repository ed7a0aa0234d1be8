"""What every package shares: errors, files, vectors, frames and gradients. Knows no drones."""
