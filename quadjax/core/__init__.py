"""Code that all packages use: errors, files, vectors, frames and gradients."""
