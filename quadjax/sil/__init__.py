"""Software in the loop: exported C, or a user's autopilot, flies a simulated drone by messages."""
